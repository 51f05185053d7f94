"""Two controllers never share a file or a name in a table, whatever they are called."""

import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from ballbot_gym import TASKS, Stabilize, Trajectory, certified, files
from ballbot_gym.robot import file_name
from ballbot_train import evaluate
from ballbot_train.commands import replay as replays
from ballbot_train.commands.benchmark import benchmark
from ballbot_train.evaluation.names import file_part, shortened
from ballbot_train.evaluation.results import read_results, table_cells
from ballbot_train.policy.files import shipped_policies
from ballbot_train.report import figures
from ballbot_train.report.labels import labels
from ballbot_train.report.replay import Replay, Take
from ballbot_train.work.executors import Workers

made_by = figures.regret_figure
TAKE = Take("", Trajectory(np.arange(2.0), np.zeros((2, 8)), np.zeros((1, 2))), "k")


class Row(NamedTuple):
    """What a table needs of a row."""

    task: str
    controller: str
    labels: dict[str, Any] = {}


NAMES = (
    *(
        "ppo",
        "PPO",
        "Ppo",
        "nmpc",
        "NMPC",
        "nmpc ",
        "nmpc.",
        "_",
        "-",
        "",
        "ä",
        "rolling-ppo",
        "ppo-mujoco",
        "a/policy.json",
    ),
    *(
        "b/policy.json",
        "x/a/policy.json",
        "a-policy",
        "a/policy.safetensors",
        "ppo-0123456789ab",
        "CON",
        "p" * 200,
        "p" * 201,
    ),
)


def test_no_two_names_share_a_file_even_where_case_is_ignored() -> None:
    files = {
        f"{file_name(task, robot)}-{file_part(name)}".lower()
        for task in ("turn", "orbit")
        for robot in ("paper", "rolling")
        for name in NAMES
    }
    assert len(files) == 4 * len(NAMES)
    assert file_part(file_part("a/policy.json")) != file_part("a/policy.json")


def test_names_of_what_is_shipped_stay_in_file_names() -> None:
    for name in (*shipped_policies(Stabilize(), "paper", None), "lqr", "nmpc", "trajopt"):
        assert file_part(name) == name


def test_paths_are_shortened_to_what_tells_them_apart() -> None:
    names = ["lqr", "x/a/policy.json", "y/a/policy.json", "b/other.json"]
    assert list(shortened(names).values()) == ["lqr", "x/a/policy.json", "y/a/policy.json", "other.json"]
    assert shortened(["a/policy.json", "b/policy.json"]) == {
        "a/policy.json": "a/policy.json",
        "b/policy.json": "b/policy.json",
    }
    assert shortened(["runs/a/policy.json"]) == {"runs/a/policy.json": "policy.json"}


@pytest.fixture
def two_policies(tmp_path: Path) -> list[str]:
    shipped, paths = shipped_policies(Stabilize()), []
    for folder, learner in (("a", "apg"), ("b", "ppo")):
        (tmp_path / folder).mkdir()
        for ending in (".json", ".safetensors"):
            copied = tmp_path / folder / f"policy{ending}"
            copied.write_bytes(shipped[learner].with_suffix(ending).read_bytes())
        paths.append(str(tmp_path / folder / "policy.json"))
    return paths


def test_two_files_of_one_name_have_rows_and_recordings_of_their_own(
    two_policies: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    monkeypatch.setattr(Workers, "here", 1)  # and so in this process
    monkeypatch.setattr(figures, "save", lambda figure, path: files.write(path, b"a figure"))  # half a second each
    benchmark(["stabilize"], two_policies, episodes=1, physics="rk4", out=out)
    text = (out / "leaderboard.md").read_text()
    assert "a/policy.json" in text
    assert "b/policy.json" in text
    assert len(list((out / "recordings").iterdir())) == 2
    with pytest.raises(ValueError, match="controllers paper stabilize"):
        benchmark(["stabilize"], two_policies[:1], episodes=1, physics="rk4", out=out)
    assert len(read_results(out)[1]) == 2


def test_rows_are_added_to_a_folder_and_another_engine_is_refused(two_policies: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    for policy in (*two_policies, two_policies[0]):
        evaluate(policy, "stabilize", 1, "rk4", out=out)
    evaluate("lqr", "turn", 1, "rk4", out=out)
    rows = {(result.task, result.controller) for result in read_results(out)[1]}
    assert rows == {("stabilize", "a/policy.json"), ("stabilize", "b/policy.json"), ("turn", "lqr")}
    assert len(list((out / "recordings").iterdir())) == 3
    with pytest.raises(ValueError, match="holds results of physics 'rk4', not 'bullet'"):
        evaluate("lqr", "turn", 1, "bullet", out=out)
    assert len(read_results(out)[1]) == 3


def test_of_two_files_with_one_folder_and_name_each_keeps_its_row(two_policies: list[str], tmp_path: Path) -> None:
    out, paths = tmp_path / "out", []
    for above, path in zip("xy", two_policies, strict=True):
        shutil.copytree(Path(path).parent, tmp_path / above / "a")
        paths.append(tmp_path / above / "a" / "policy.json")
    for path in (*paths, *paths):
        evaluate(path, "stabilize", 1, "rk4", out=out)
    assert [result.controller for result in read_results(out)[1]] == ["a/policy.json", "y/a/policy.json"]
    assert len(list((out / "recordings").iterdir())) == 2


def test_two_functions_of_one_name_do_not_share_a_row(tmp_path: Path) -> None:
    policies = [lambda observation: np.zeros(2), lambda observation: np.ones(2)]
    for policy in (policies[0], policies[0]):
        evaluate(policy, "stabilize", 1, "rk4", out=tmp_path)
    before = (tmp_path / "leaderboard.json").read_bytes()
    with pytest.raises(
        ValueError, match=r"holds a row '<lambda>' on stabilize of another policy.*give this one another name"
    ):
        evaluate(policies[1], "stabilize", 1, "rk4", out=tmp_path)
    assert (tmp_path / "leaderboard.json").read_bytes() == before
    evaluate(policies[1], "stabilize", 1, "rk4", "full force", out=tmp_path)
    with pytest.raises(ValueError, match="holds a row 'full force'"):
        evaluate(policies[0], "stabilize", 1, "rk4", "full force", out=tmp_path)
    assert [result.controller for result in read_results(tmp_path)[1]] == ["<lambda>", "full force"]


class Dearer(Stabilize):
    """Stabilize with another cost, under its name."""

    def cost(self, x, u, c):
        return 1.001 * super().cost(x, u, c)


def test_rows_of_two_problems_of_one_name_do_not_share_a_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = certified.load("stabilize", "paper")
    evaluate("lqr", "stabilize", 1, "rk4", out=tmp_path)
    monkeypatch.setattr(certified, "load", lambda *given, **more: known)
    Dearer.__name__ = "Stabilize"
    monkeypatch.setitem(TASKS, "stabilize", Dearer)
    with pytest.raises(ValueError, match="another problem stabilize: its costs have changed since"):
        evaluate("apg", "stabilize", 1, "rk4", out=tmp_path)
    assert [result.controller for result in read_results(tmp_path)[1]] == ["lqr"]


def test_labels_of_one_figure_are_different() -> None:
    names = ["x/a/policy.json", "y/a/policy.json", "a/policy.zip", "ppo", "PPO", "b/other.json", "lqr"]
    found = labels(names)
    assert len(set(found.values())) == len(names)
    assert (found["b/other.json"], found["lqr"]) == ("b/other", "LQR")
    assert labels(["runs/a/policy.json"]) == {"runs/a/policy.json": "a/policy"}


def test_a_shipped_policy_is_called_by_the_whole_way_of_its_training() -> None:
    ways = {
        "turn/ppo": "dagger → apg → ppo",
        "turn/apg-late": "dagger → apg",
        "orbit/ppo": "ppo",
        "rolling/turn/ppo": "ppo",
    }
    rows = [Row("turn", name) for name in ("ppo", "apg-late", "lqr", "a/ppo.json")] + [Row("orbit", "ppo")]
    shown = {"task": lambda row: row.task, "controller": lambda row: row.controller}
    cells = [controller for _, controller in table_cells(shown, rows, ways)]
    assert cells == ["dagger → apg → ppo", "dagger → apg-late", "lqr", "ppo.json", "ppo"]
    made = Row("turn", "ppo", labels={"made_for": "rolling", "robot": "paper"})
    assert table_cells(shown, [made], ways) == [["turn", "ppo"]]
    assert labels(["ppo", "lqr"], "turn", ways) == {"ppo": "DAgger → APG → PPO", "lqr": "LQR"}


def test_table_terminal_report_and_figure_show_the_whole_way(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    figure = {}
    monkeypatch.setattr(Workers, "here", 1)  # and so in this process
    monkeypatch.setattr(figures, "regret_figure", lambda *given: figure.setdefault("made", made_by(*given)))
    benchmark(["stabilize"], ["ppo"], episodes=1, physics="rk4", out=tmp_path)
    way = "dagger → apg → ppo"
    assert way in " ".join(capsys.readouterr().out.split())
    assert way in (tmp_path / "leaderboard.md").read_text()
    page = (tmp_path / "report.html").read_text()
    assert way in page
    assert "DAgger → APG → PPO" in page
    (legend,) = figure["made"].legends
    assert [text.get_text() for text in legend.get_texts()] == ["DAgger → APG → PPO"]


def test_no_two_films_share_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []
    monkeypatch.setattr(replays, "certified_replay", lambda *given, **more: Replay("", (TAKE,)))
    monkeypatch.setattr(replays, "write_strip", lambda shown, path, *rest: written.append(path.name) or path)
    told = [
        {"controllers": ("lqr", "trajopt")},
        {"controllers": ("lqr-trajopt",)},
        {"controllers": ("lqr",)},
        {"controllers": ("lqr",), "physics": "rk4"},
        {"controllers": ("lqr-rk4",)},
        {"controllers": ("lqr",), "frictions": (0.8,)},
        {"controllers": ("lqr",), "frictions": (0.8000001,)},
        {"controllers": ("lqr",), "frictions": (0.8, 0.6)},
        {"controllers": ("lqr-0+0.8",)},
        {"controllers": ("lqr",), "episode": 10},
        {"controllers": ("lqr-1",)},
        {"controllers": ("lqr",), "robot": "rolling"},
        {"controllers": ("rolling-lqr",)},
    ]
    for options in told:
        replays.replay(("stabilize",), out=tmp_path, **options)
    assert len({name.lower() for name in written}) == len(told)
