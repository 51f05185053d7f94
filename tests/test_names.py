"""Two controllers never share a file or a name in a table, whatever they are called."""

from pathlib import Path

import pytest

from ballbot_gym import Stabilize
from ballbot_train import evaluate
from ballbot_train.commands.benchmark import benchmark
from ballbot_train.evaluation.names import file_part, shortened
from ballbot_train.evaluation.recordings import file_of
from ballbot_train.evaluation.results import read_results
from ballbot_train.policy.files import shipped_policies

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
        file_of(task, robot, name).lower()
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
    for folder, learner in (("a", "shac"), ("b", "ppo")):
        (tmp_path / folder).mkdir()
        for ending in (".json", ".safetensors"):
            copied = tmp_path / folder / f"policy{ending}"
            copied.write_bytes(shipped[learner].with_suffix(ending).read_bytes())
        paths.append(str(tmp_path / folder / "policy.json"))
    return paths


def test_two_files_of_one_name_have_rows_and_recordings_of_their_own(two_policies: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
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
