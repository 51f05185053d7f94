"""What the leaderboard's page holds besides its table, each part where its data exist."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from markupsafe import Markup

from ballbot_gym import files
from ballbot_gym.robots import PAPER
from ballbot_train.evaluation.results import Result
from ballbot_train.report.page import Section, folder_section, pictures_section, replay_section, table_section
from ballbot_train.report.playground import playground_page
from ballbot_train.report.replay import Replay, certified_replay


def leaderboard_sections(
    header: Sequence[str],
    table: Sequence[Sequence[str]],
    results: Sequence[Result],
    controllers: Mapping[str, Sequence[str]],
    regrets: Path,
    pictures: Sequence[Path],
    physics: str,
    runs: Path,
    robot: str = PAPER,
) -> list[Section | None]:
    """The page of `ballbot benchmark`.

    Args:
        header: the names of the leaderboard's columns.
        table: its cells.
        results: its episodes.
        controllers: by task.
        regrets: picture of the regrets of all episodes.
        pictures: of certified episodes.
        physics: "bullet", "mujoco" or "rk4".
        runs: folder in which other commands have left theirs: basins, robustness, transfer and paper.
        robot: by name; what other commands have left of other robots is left out.
    """
    replays = [replay_of(task, names, results, physics, robot) for task, names in controllers.items()]
    return [
        table_section(
            "Leaderboard",
            header,
            table,
            "Regret is cost / optimum − 1 over the episodes that did not fail. Press a column's head to sort by it.",
        ),
        replay_section(
            "Watch an episode",
            replays,
            "The same start under every controller. Drag to turn the camera; play, or drag the time; "
            "the pink line is the force on the ball.",
        ),
        playground_section(),
        pictures_section(
            "How close to the optimum",
            [regrets],
            "The higher and the farther left, the better. A curve ends at the share of episodes that succeed.",
        ),
        pictures_section(
            "Basins of attraction",
            [path for path in (runs / "basins" / "basins.png",) if path.exists() and _is_of(path, robot)],
            "From where each controller recovers, within what the robot allows.",
        ),
        folder_section("Robustness", runs / "robustness" / "figures", "The same episodes under growing disturbances.")
        if _is_of(runs / "robustness" / "robustness.json", robot)
        else None,
        pictures_section(
            "From one robot to another",
            [path for path in (runs / "transfer" / "transfer.png",) if path.exists()],
            "Controllers that plan for one robot, or learnt on it, on another and on its floors.",
        ),
        pictures_section("One certified episode of each task", pictures),
        folder_section("The paper's figures", runs / "paper", "High lean angle trajectory optimization, reproduced."),
    ]


def _is_of(path: Path, robot: str) -> bool:
    """Whether the results that a command left as PATH.json are of a robot, as far as they say."""
    try:
        return files.read_json(path.with_suffix(".json"))["about"].get("robot", PAPER) == robot
    except (ValueError, KeyError, TypeError, AttributeError):  # missing or damaged: they do not say
        return robot == PAPER


def replay_of(
    task: str, controllers: Sequence[str], results: Sequence[Result], physics: str, robot: str = PAPER
) -> Replay:
    """A telling episode of a task: the first in which one controller fails and another does not, else the first."""
    failures: dict[int, set[bool]] = {}
    for result in results:
        if result.task == task:
            failures.setdefault(result.episode, set()).add(result.failure)
    episode = next((episode for episode, seen in sorted(failures.items()) if len(seen) == 2), min(failures))
    return certified_replay(task, controllers, episode, physics, skip_planless=True, robot=robot)


def playground_section() -> Section:
    """The playground, which runs in the page."""
    fit = "this.style.height = this.contentDocument.documentElement.scrollHeight + 'px'"  # so that nothing of it is cut off
    frame = Markup(
        f'<iframe class="playground" title="the playground" loading="lazy" onload="{fit}" srcdoc="{{}}"></iframe>'
    )
    lead = "A learned policy and LQR, computed in this page. Push them."
    return Section("Push them yourself", frame.format(playground_page()), lead)
