"""The parts of the leaderboard's page."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from markupsafe import Markup

from ballbot_gym.robots import PAPER
from ballbot_train.evaluation.results import Result
from ballbot_train.report.page import Section, pictures_section, replay_section, table_section
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
        robot: by name.
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
        pictures_section("One certified episode of each task", pictures),
    ]


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
