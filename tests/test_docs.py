"""What README and documentation say runs as it stands, as a reader would paste it, page by page."""

import dataclasses
import hashlib
import json
import math
import re
import shlex
import subprocess
import sys
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import pytest
from builders import classic_systems, measured
from stable_baselines3 import PPO

from ballbot_gym import BallbotEnv, files, named_robot
from ballbot_gym.tasks import TASKS
from ballbot_train.commands import COMMANDS
from ballbot_train.evaluation import adversarial, fresh
from ballbot_train.evaluation.submissions import read_entries
from ballbot_train.learning import dagger, model_free, training
from ballbot_train.policy.files import SHIPPED, PolicyFile, shipped_ways
from ballbot_train.report import figures
from ballbot_train.work.executors import Workers

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
CLIENTS = ROOT / "docs" / "clients.md"  # whose code test_clients.py runs where the clients are installed
SHORTER = {  # a training that a page calls `# minutes` runs with these too
    "dagger": "--iterations 1 --episodes-per-iteration 2 --gradient-steps 5",
    "ppo": "--iterations 1 --num-envs 64 --num-steps 48",
    "apg": "--iterations 1 --num-envs 8 --episode-seconds 0.1",
}
OTHERS = {"--help", "--version", "--env-id"}
"""Options on pages that are not listed by the help of a command: of all commands, and of another program."""
MEASURED = "--evaluations 1 --test-episodes 2 --validation-episodes 2"
MEASURED_AS = measured(1.5, 30.0, 30.0)
"""What its evaluations say, in place of running hundreds of episodes for each."""


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), flags=re.DOTALL)


def pages_with(language):
    return {str(page.relative_to(ROOT)): page for page in PAGES if blocks(page, language) and page != CLIENTS}


@pytest.mark.parametrize("page", pages_with("python").values(), ids=pages_with("python"))
def test_python_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    learn = PPO.learn
    monkeypatch.setattr("ballbot_train.evaluation.evaluate.checked_episodes", lambda episodes: min(episodes, 3))

    def learn_little(self, steps, *more):
        self.n_epochs = 1
        return learn(self, 1, *more)  # one rollout

    monkeypatch.setattr(PPO, "learn", learn_little)
    namespace = {"__name__": "example"}
    with classic_systems() if page.name == "classic.md" else nullcontext():
        if page.name == "classic.md":
            from ballbot_classic import pendulum_cases

            monkeypatch.setattr(pendulum_cases, "_SOLVED", 4)  # test_classic.py tests whole searches
        for block in blocks(page, "python"):
            exec(compile(block, str(page), "exec", dont_inherit=True), namespace)


def test_the_task_that_is_added_can_be_certified(interpreted):
    from ballbot_baselines import find_optimum
    from ballbot_gym.certified.cache import episode

    names = {"__name__": "sprint"}
    code = blocks(next(page for page in PAGES if page.name == "own.md"), "python")[0]
    exec(code, names)
    task, robot = names["Sprint"](), named_robot("paper")
    # from a guess that stops at the line this one had no optimum
    assert find_optimum(task, robot, *episode(task, robot, 14)).is_optimal


@pytest.mark.parametrize("page", pages_with("sh").values(), ids=pages_with("sh"))
def test_commands_run(page, typed, monkeypatch):
    real = fresh.evaluate_fresh
    monkeypatch.setattr(Workers, "here", 1)  # and so in this process; other tests start workers
    monkeypatch.setattr(training, "score_and_validate", lambda *policy: MEASURED_AS)
    monkeypatch.setattr(model_free, "_CLONE_ITERATIONS", 1)
    monkeypatch.setattr(dagger, "_SECONDS", 0.5)
    for command in ("benchmark", "evaluate", "robustness"):
        monkeypatch.setattr(f"ballbot_train.commands.{command}.checked_episodes", lambda episodes: 2)
    monkeypatch.setattr("ballbot_train.evaluation.evaluate.checked_episodes", lambda episodes: min(episodes, 2))
    monkeypatch.setattr(figures, "save", lambda figure, path: files.write(path, b"a figure"))  # half a second each
    monkeypatch.setattr(fresh, "evaluate_fresh", lambda policy, task, count, *more: real(policy, task, 4, *more))
    optima = fresh.FreshResult.with_optima
    few = lambda result, count, workers: optima(result, min(count, 2), workers)  # noqa: E731
    monkeypatch.setattr(fresh.FreshResult, "with_optima", few)
    monkeypatch.setattr(adversarial, "hard_starts", partial(adversarial.hard_starts, rounds=1))
    monkeypatch.setattr(adversarial, "_CLIMBS", 0)
    monkeypatch.setattr(adversarial, "_CHECKED", 0)
    makefile = (ROOT / "Makefile").read_text()
    for line in "\n".join(blocks(page, "sh")).splitlines():
        command = shlex.split(line, comments=True)
        if not command:
            continue
        if line.endswith("# minutes"):
            assert command[:2] == ["ballbot", "train"], line
            command += shlex.split(f"{SHORTER[command[2]]} {MEASURED}")
        if "--seconds" in command:
            at = command.index("--seconds") + 1
            command[at] = str(min(float(command[at]), 6.0))
        if command[0] == "make":  # what CI runs, this test within it
            assert re.search(rf"^{command[1]}:", makefile, flags=re.MULTILINE), line
            continue
        assert command[0] == "ballbot", f"{line}: how is this tested?"
        ended, printed = typed(*command[1:])
        assert ended == 0, f"{line}\n{printed}"


def test_pages_show_the_same_plain_ppo_and_the_example_has_its_settings():
    shown = {block for page in PAGES for block in blocks(page, "python") if "class OddPolicy" in block}
    assert len(shown) == 1
    pages = [page.name for page in PAGES if shown & set(blocks(page, "python"))]
    assert pages == ["README.md", "clients.md", "start.md"]
    settings = re.findall(r"\b(\w+)=([\w.]+),", shown.pop())
    example = (ROOT / "examples" / "plain_ppo.py").read_text()
    assert {name for name, _ in settings} >= {"n_steps", "batch_size", "n_epochs", "gamma", "gae_lambda"}
    assert [name for name, value in settings if name != "seed" and f"{name}={value}" not in example] == []


def test_no_block_is_of_a_kind_that_nothing_runs():
    kinds = {kind for page in PAGES for kind in re.findall(r"^```(\w+)$", page.read_text(), flags=re.MULTILINE)}
    assert kinds <= {"python", "sh", "bibtex"}


def test_pictures_and_commands_that_pages_name_exist():
    from ballbot_train.commands import COMMANDS

    for page in PAGES:
        for picture in re.findall(r"!\[[^]]*\]\(([^)]*)\)", page.read_text()):
            assert (page.parent / picture).exists(), f"{page}: {picture}"
        assert set(re.findall(r"`ballbot (\w+)", page.read_text())) <= set(COMMANDS), page


def test_films_are_small_enough_to_load_at_once():
    films = sorted((ROOT / "docs" / "pictures").glob("*.webp"))
    assert [film.stem for film in films] == ["lean", "playground", "slip"]
    assert max(film.stat().st_size for film in films) <= 2e6


def test_pictures_are_of_the_policies_that_are_shipped():
    """Where this fails, `make pictures` makes them anew. An entry may be marked as outdated until then, by hand."""
    sys.path.insert(0, str(ROOT / "docs"))
    import make_pictures

    sys.path.remove(str(ROOT / "docs"))
    made = json.loads(make_pictures.MADE.read_text())
    assert set(made) == {name for make in make_pictures.MAKES for name in make.files}
    for make in make_pictures.MAKES:
        now = make_pictures.record(make, make.policies())
        for name in make.files:
            assert (make_pictures.PICTURES / name).exists()
            assert made[name].get("outdated") or made[name] == now, f"{name}: {make.command}"


def test_every_page_that_is_linked_exists():
    for page in PAGES:
        prose = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
        for link in re.findall(r"\]\(([^)#:]*)[^):]*\)", prose):
            assert not link or (page.parent / link).exists(), f"{page.relative_to(ROOT)}: {link}"


def test_the_documentation_says_of_every_shipped_policy_what_its_file_says():
    text = "".join((ROOT / "docs" / page).read_text() for page in ("policies.md", "tracks.md"))
    for path in sorted(SHIPPED.glob("*.json")):
        about = json.loads(path.read_text())
        measured, training = about["measured"], about["training"]
        seconds = about["training_seconds"]
        kind = ", ".join(training[name] for name in ("task", "robot", "randomization") if name in training)
        informed = "informed: " * bool(about["spec"].get("informed"))
        row = (
            f"| {informed}{kind} | {training['learner']} | {seconds / 60:.0f} min | {measured['success']:.1%} | "
            f"{measured['falls']} | {measured['regret_mean']:.2%} | {measured['regret_median']:.2%} |"
        )
        assert row in text, row


def table(page, header):
    """Cells of the rows of the page's table whose header starts so."""
    _, _, rest = page.read_text().partition(header)
    rows = rest.partition("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]


@pytest.mark.parametrize("name", sorted(TASKS))
def test_the_page_of_a_task_says_what_its_env_has(name):
    page, env = ROOT / "docs" / "tasks" / f"{name}.md", BallbotEnv(name, physics="rk4")
    rows = table(page, "| number | quantity |")
    scales = {int(number): float(row[2]) for row in rows for number in row[0].split(",")}
    assert tuple(scales[i] for i in range(len(scales))) == env.task.observation_scale
    shared = table(ROOT / "docs" / "tasks" / "index.md", "| name | meaning |")
    arguments = {row[0]: row[3] for row in (*table(page, "| name | meaning |"), *shared)}
    told = {
        argument: math.radians(float(default[:-1])) if default.endswith("°") else float(default)
        for argument, default in arguments.items()
    }
    assert told == pytest.approx({field.name: field.default for field in dataclasses.fields(env.task)})
    assert str(env.task.reward_threshold) in page.read_text()


def test_the_leaderboard_s_page_is_made_from_its_rows():
    """Where this fails, `python docs/make_leaderboard.py` writes it anew."""
    sys.path.insert(0, str(ROOT / "docs"))
    import make_leaderboard

    sys.path.remove(str(ROOT / "docs"))
    assert make_leaderboard.page() == make_leaderboard.PAGE.read_text()


def test_the_page_of_training_from_scratch_shows_the_runs(monkeypatch):
    """Where this fails, `python docs/make_learning_curves.py` writes it anew."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    import make_learning_curves

    assert make_learning_curves.page() == make_learning_curves.PAGE.read_text()


def test_the_films_are_of_the_submissions_that_the_leaderboard_has_and_small():
    """Where this fails, `make gallery` makes them anew."""
    sys.path.insert(0, str(ROOT / "docs"))
    import make_gallery

    sys.path.remove(str(ROOT / "docs"))
    films = {make_gallery.make_leaderboard.film(row, episode): row for row, episode in make_gallery.films()}
    made = json.loads(make_gallery.MADE.read_text())
    for name, film in made.items():  # a row that is sent may come without films
        assert film["submission"] == films[name].submission
        assert (make_gallery.FILMS / name).stat().st_size <= 160e3
    assert {path.name for path in make_gallery.FILMS.glob("*.webp")} == set(made)
    assert make_gallery.page(made) == make_gallery.PAGE.read_text()


def test_the_readme_s_results_are_rows_of_the_leaderboard():
    header = "| controller | Stabilize | Turn | Orbit | Weave |"
    tasks = [task.strip().lower() for task in header.strip("| ").split("|")[1:]]
    rows = table(ROOT / "README.md", header)
    short = {
        (task, controller): cell for controller, *cells in rows for task, cell in zip(tasks, cells, strict=True) if cell
    }
    expected = {}
    for entry in read_entries():
        name = shipped_ways().get(entry.policy, entry.name)
        if (entry.task, name) in short and entry.robot == "paper" and entry.physics == "bullet":
            parts = [] if entry.regret_mean is None else [f"{100 * entry.regret_mean:.2f} %"]
            parts += [f"{entry.falls} fail"] if entry.falls else []
            misses = entry.ends.count("missed")
            expected[entry.task, name] = ", ".join(parts + ([f"{misses} miss"] if misses else []))
    assert len(expected) > 10
    assert short == expected


def test_rows_and_policies_say_by_which_learners_they_came():
    way_of_demonstrations = "dagger → apg → ppo"
    assert shipped_ways()[PolicyFile(SHIPPED / "stabilize-ppo.json").weights_digest()] == way_of_demonstrations
    assert shipped_ways()[PolicyFile(SHIPPED / "turn-apg.json").weights_digest()] == "dagger → apg"
    assert shipped_ways()[PolicyFile(SHIPPED / "weave-dagger.json").weights_digest()] == "dagger"
    assert shipped_ways()[PolicyFile(SHIPPED / "stabilize-omni_strong-apg.json").weights_digest()] == "apg"
    entries = [entry for entry in read_entries() if entry.name in ("dagger", "apg", "sac", "ppo")]
    assert entries
    assert all(shipped_ways()[entry.policy].endswith(entry.name) for entry in entries)


def options_of(typed, *command):
    """The options that the help of a command names."""
    return set(re.findall(r"--[a-z][a-z-]*", typed(*command, "--help")[1]))


def test_options_that_pages_name_are_options_of_the_commands(typed):
    learners = {name: options_of(typed, "train", name, "--task", "weave") for name in SHORTER}
    options = {name: options_of(typed, name) for name in COMMANDS if name != "train"} | learners
    everywhere = set.union(*options.values())
    pages = [page for page in PAGES if page.name != "changelog.md" and "experiments" not in page.parts]
    for page in pages:
        text = page.read_text()
        named = set(re.findall(r"`(--[a-z][a-z-]*)", text))
        assert named - everywhere <= OTHERS, page
        for line in re.findall(r"`ballbot ([^`]+)`", text):  # an option in a command's line is one of this command
            name, learner, *_ = [*line.split(), "", ""]
            of = (
                learners.get(learner, set.union(*learners.values()))
                if name == "train"
                else options.get(name, everywhere)
            )
            assert set(re.findall(r"--[a-z][a-z-]*", line)) <= of | {"--help", "--version"}, f"{page}: {line}"
    _, _, table = (ROOT / "docs" / "settings.md").read_text().partition("## Options of all learners")
    assert set(re.findall(r"`(--[a-z][a-z-]*)", table)) <= set.union(*learners.values())


def test_every_page_of_experiments_answers_its_question_at_once_and_all_its_data_are_linked():
    folder = ROOT / "docs" / "experiments"
    pages = [page for page in folder.glob("*.md") if page.name != "index.md"]
    index = (folder / "index.md").read_text()
    for page in pages:
        title, _, answer, *_ = page.read_text().splitlines()
        assert title.endswith("?"), page
        assert answer.startswith("**"), page
        assert re.search(r"\*\* \*\w+ 20\d\d\*\n", " ".join(page.read_text().split("\n\n")[1].split()) + "\n"), page
        assert f"]({page.name})" in index, page
    linked = {name for page in pages for name in re.findall(r"\]\(([\w-]+\.csv)\)", page.read_text())}
    assert linked == {data.name for data in folder.glob("*.csv")}


def layout():
    """Paths of the tree in CONTRIBUTING.md, relative to the root; patterns such as `*.npz` stand for several files."""
    _, _, text = (ROOT / "CONTRIBUTING.md").read_text().partition("## Layout")
    folders, paths = [], []
    for line in re.search(r"```\n(.*?)```", text, flags=re.DOTALL)[1].splitlines():
        depth = (len(line) - len(line.lstrip())) // 4
        name = line.split()[0]
        folders = folders[:depth]
        if name.endswith("/"):
            folders.append(name)
        else:
            paths.append("".join(folders) + name)
    return paths


def test_the_layout_in_contributing_lists_exactly_the_files_that_exist():
    listed = layout()
    assert [path for path in listed if not list(ROOT.glob(path))] == [], "listed, but do not exist"
    folders = sorted({path.partition("/")[0] for path in listed if "/" in path})
    assert {"ballbot_gym", "baselines", "train", "tests"} <= set(folders)
    existing = {
        path
        for folder in folders
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and not path.name.startswith(".")
    }
    found = {path for pattern in listed for path in ROOT.glob(pattern)}
    assert sorted(str(path.relative_to(ROOT)) for path in existing - found) == [], "exist, but are not listed"


def test_version_is_the_same_everywhere():
    version = re.search(r'^version = "(.*)"$', (ROOT / "pyproject.toml").read_text(), flags=re.MULTILINE)[1]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"version = {{{version}}}" in (ROOT / "README.md").read_text()
    assert f"## [{version}]" in (ROOT / "CHANGELOG.md").read_text()


def test_the_metadata_for_search_engines_describes_the_certified_sets_as_they_are():
    """Where this fails, `make metadata` writes them anew."""
    described = json.loads((ROOT / "docs" / "certified.croissant.json").read_text())["distribution"]
    held = {each["name"]: (each["sha256"], each["contentSize"]) for each in described}
    sets = (ROOT / "ballbot_gym" / "certified").glob("*.npz")
    contents = {path.name: path.read_bytes() for path in sets}
    assert held == {name: (hashlib.sha256(of).hexdigest(), f"{len(of)} B") for name, of in contents.items()}


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    start = (tmp_path / "index.html").read_text()
    assert "<!-- file" not in start
    assert "Two commands" in start
    assert 'href="playground/page.html"' in start
    assert '<img loading="lazy" alt="film of episode' in (tmp_path / "leaderboard" / "index.html").read_text()
    assert (tmp_path / "playground" / "page.html").stat().st_size > 1e6
    assert "discrete_lqr" in (tmp_path / "api" / "ballbot_baselines.solvers.riccati" / "index.html").read_text()
