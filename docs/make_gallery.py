"""Films of certified episodes for gallery.md and leaderboard.md, which list them, and regret.png: make gallery.

Each row of the leaderboard has a film of its best and of its worst episode. The gallery shows one episode of each task under
four rows, and the worst one of the best policy. A film is made if there is none of the row's submission. It shows the motion
of the submission next to the row, or else that of the shipped controller of the row's name. pictures/films/made.json says
which submission each film shows, how wide it is, and how the episode ended.
"""

import io
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import make_leaderboard
import numpy as np
from PIL import Image

from ballbot_baselines import CONTROLLERS, find_optimum
from ballbot_gym import certified, files
from ballbot_gym.drawing import GHOST_OPACITY, Drawing, Drawn, GroundPath
from ballbot_gym.drawing.picture import picture
from ballbot_gym.engines import PHYSICS
from ballbot_gym.env import make_task
from ballbot_gym.robot import PAPER, named_robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import TASKS
from ballbot_gym.trajectory import Trajectory
from ballbot_train.evaluation import recordings
from ballbot_train.evaluation.submissions import LEADERBOARD, Entry, read_entries
from ballbot_train.policy.files import SHIPPED
from ballbot_train.report import figures, labels
from ballbot_train.report.replay import Replay, Take, certified_replay

PAGE = Path(__file__).parent / "gallery.md"
FILMS = make_leaderboard.FILMS
MADE = FILMS / "made.json"
EPISODES = {"stabilize": 7, "turn": 34, "orbit": 122, "weave": 12}
"""The telling episode of each task."""
_LISTS = re.compile(r"(<!-- films -->\n).*(<!-- end of films -->)", flags=re.DOTALL)
_SIZE, _FPS, _QUALITY = (400, 300), 10, 25  # px, pictures per second, and WebP's quality
_LONGEST, _AFTER = 5.0, 0.4  # s: of the motion; shown of a robot that has fallen
_TOLERANCE = 1e-3  # of the optimum's cost beside the certified one
_LAST_MS = 1500  # for which the last picture is shown


def shown(task: str) -> list[Entry]:
    """The rows of a task in the gallery: LQR, NMPC, and the best shipped policy. Trajopt would hide its ghost."""
    rows = [row for row in read_entries() if (row.task, row.robot) == (task, PAPER)]
    experts = [row for name in ("lqr", "nmpc") for row in rows if row.name == name]
    policies = [row for row in rows if (SHIPPED / f"{task}-{row.name}.json").exists()]
    return [*experts, min(policies, key=lambda row: (-row.success, row.regret_mean or 0.0))]


def films() -> Iterator[tuple[Entry, int]]:
    """Every row and episode that is filmed, each once."""
    found = {}
    for row in read_entries():
        found |= {make_leaderboard.film(row, i): (row, i) for i in make_leaderboard.extremes(row)}
    for task, episode in EPISODES.items():
        found |= {make_leaderboard.film(row, episode): (row, episode) for row in shown(task)}
    yield from found.values()


def page(notes: dict[str, dict[str, str]]) -> str:
    """The gallery as the films make it."""
    parts = []
    for task, episode in EPISODES.items():
        parts.append(f"## {task.capitalize()}, episode {episode}\n")
        rows = shown(task)
        worst = make_leaderboard.extremes(rows[-1])[1]
        for row, i, when in [*((row, episode, "") for row in rows), (rows[-1], worst, f", in episode {worst}")]:
            name = make_leaderboard.film(row, i)
            label = labels.label(row.name)
            parts.append(f"![{row.name}](pictures/films/{name})\n{label}{when}: {notes[name]['note']}\n")
    text = "\n".join(parts)
    return _LISTS.sub(lambda match: f"{match[1]}\n{text}\n{match[2]}", PAGE.read_text(encoding="utf-8"))


def _has_motion(row: Entry) -> bool:
    """Whether there is a submission next to the row, or a shipped controller of its name."""
    shipped = row.name in CONTROLLERS or (SHIPPED / f"{row.task}-{row.name}.json").exists()
    return shipped or (LEADERBOARD / row.file).with_suffix(".npz").exists()


def take_of(row: Entry, episode: int) -> tuple[Replay, Trajectory]:
    """What a row did in an episode, and the optimum, which is its ghost."""
    path = (LEADERBOARD / row.file).with_suffix(".npz")
    replay = certified_replay(row.task, ["lqr" if path.exists() else row.name], episode, row.physics, robot=row.robot)
    (take,) = replay.takes
    if path.exists():
        take = Take(
            row.name, _recorded(path, row, episode), labels.color(row.name, 0), failed=row.results()[episode].failure
        )
    known, task, params = certified.load(row.task, row.robot), make_task(row.task, row.robot), named_robot(row.robot)
    optimum = find_optimum(task, params, known.states[episode], known.constants[episode], twice=True)
    if optimum.cost > (1 + _TOLERANCE) * known.costs[episode]:
        raise PlanError(
            f"{row.task} {episode}: the search found {optimum.cost}, and {known.costs[episode]} is certified"
        )
    return replace(replay, takes=(take,)), optimum.trajectory


def _recorded(path: Path, row: Entry, episode: int) -> Trajectory:
    """An episode of a submission."""
    held = recordings.Recording.read(path)
    steps = held.lengths[:episode].sum()
    states, n = steps + np.count_nonzero(held.lengths[:episode]), held.lengths[episode]
    forces = held.actions[steps : steps + n] * named_robot(row.robot).force_limit
    return Trajectory(
        make_task(row.task, row.robot).control_dt * np.arange(n + 1), held.states[states : states + n + 1], forces
    )


def drawing(replay: Replay, optimum: Trajectory, t: float) -> Drawing:
    """A moment, s, with the optimum as a ghost."""
    drawn = replay.drawing(replay.takes[0], t)
    ghost = Drawn(optimum.state(t), labels.OPTIMUM, alpha=GHOST_OPACITY)
    path = GroundPath(optimum.states_until(t)[:, :2], labels.OPTIMUM, True)
    return replace(drawn, robots=(ghost, *drawn.robots), paths=(*drawn.paths, path))


def film(replay: Replay, optimum: Trajectory) -> bytes:
    """An animated WebP."""
    (take,) = replay.takes
    end = min(take.trajectory.duration + (_AFTER if take.failed else 0), _LONGEST)
    first, *others = (
        Image.fromarray(picture(drawing(replay, optimum, t), *_SIZE)) for t in np.arange(0, end + 1e-6, 1 / _FPS)
    )
    durations = [1000 // _FPS] * len(others) + [_LAST_MS]
    buffer = io.BytesIO()
    options = {"save_all": True, "append_images": others, "duration": durations, "loop": 0}
    first.save(buffer, "WEBP", quality=_QUALITY, method=6, **options)
    return buffer.getvalue()


def note(row: Entry, episode: int) -> str:
    """How an episode ended: its regret, or its failure."""
    result = row.results()[episode]
    if result.failure:
        end = row.ends[episode]
        return "falls" if end == "tilt" else "touches an obstacle" if end.startswith("obstacle") else f"fails: {end}"
    return f"{round(100 * (result.cost / result.optimum - 1), 1) + 0.0:.1f} %"  # 0.0, and not -0.0


def main() -> None:
    """Makes the films that are missing, removes those that nothing shows, and writes both pages."""
    made = json.loads(MADE.read_text()) if MADE.exists() else {}
    known = {}
    for row, episode in films():
        name = make_leaderboard.film(row, episode)
        before = made.get(name, {})
        held = (before.get("submission"), before.get("width")) == (row.submission, _SIZE[0])
        if not held and not _has_motion(row):
            continue
        known[name] = {"submission": row.submission, "width": _SIZE[0], "note": note(row, episode)}
        if not held:
            files.write(FILMS / name, film(*take_of(row, episode)))
            print(f"{name}: {(FILMS / name).stat().st_size / 1000:.0f} kB, {known[name]['note']}", flush=True)
            files.write(MADE, json.dumps(made := made | {name: known[name]}, indent=1) + "\n")
    for path in FILMS.glob("*.webp"):
        if path.name not in known:
            path.unlink()
    files.write(MADE, json.dumps(dict(sorted(known.items())), indent=1) + "\n")
    rows = [row for row in read_entries() if (row.robot, row.physics) == (PAPER, next(iter(PHYSICS)))]
    results = [result for task in TASKS for row in rows if row.task == task for result in row.results()]
    figures.save(figures.regret_figure(results), FILMS.parent / "regret.png")
    files.write(PAGE, page(known))
    files.write(make_leaderboard.PAGE, make_leaderboard.page())


if __name__ == "__main__":
    main()
