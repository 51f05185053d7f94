"""`ballbot prove`: checks the proofs that stored optima are strict local minima, and a lower bound of planar costs."""

import time

from ballbot_baselines import PlanarBound
from ballbot_baselines.proofs.minima import _lines, _summary
from ballbot_baselines.proofs.planar_bound import _tightness, check_parts
from ballbot_gym import certified
from ballbot_gym.env import make_task
from ballbot_gym.machine_code import NoMachineCodeError
from ballbot_gym.tasks import TASKS
from ballbot_train.work.console import check_least, check_names, console, progress_bar

_STARTS = 200  # of which the bound is compared with the optimum
_STORED = 20  # episodes of a set whose forces come with the package
_STATEMENT = """\
Proven for all 800 certified optima of the paper's robot: near it is a strict local minimum of the episode as the
environment computes it, with RK4 steps, held forces, bounds of forces, tilt, arena and obstacles, and the goal. Interval
arithmetic encloses the minimum and its cost. The theorem is at the top of ballbot_baselines/proofs/local_minimum.py.
--planar proves a lower bound of the cost of every successful planar episode of Stabilize from two fifths of the starts.
Not proven: that no other motion costs less than these optima. docs/experiments/global-optima.md says what was counted.
--check computes the proofs, in one to five seconds per episode."""


def prove(
    *, check: bool = False, planar: bool = False, tasks: tuple[str, ...] = tuple(TASKS), episodes: int = _STORED
) -> None:
    """Proves in interval arithmetic that stored optima are strict local minima, and encloses their costs.

    Args:
        check: compute the proofs; without it, the command says what is proven.
        planar: check instead the lower bound of the cost of every successful episode of Stabilize in a vertical plane.
        tasks: names of tasks.
        episodes: the first of each certified set; the forces of the first 20 are stored, and those of others are searched.
    """
    check_names("task", tasks, TASKS, least=1)
    check_least(1, episodes=episodes)
    if episodes > certified.EPISODES:
        raise ValueError(f"episodes must be at most {certified.EPISODES}, not {episodes}")
    if planar:
        _prove_bound()
        return
    if not check:
        console.print(_STATEMENT, soft_wrap=True)
        return
    began, rows = time.perf_counter(), []
    for name in tasks:
        with progress_bar() as progress:
            bar = progress.add_task(f"minima of {name}", total=episodes)
            some = []
            for row in _lines(name, range(episodes)):
                some.append(row)
                progress.advance(bar)
        console.print(_summary(name, some), soft_wrap=True)
        rows += some
    proven = sum(row["proven"] for row in rows)
    console.print(f"{proven} of {len(rows)} minima enclosed, {time.perf_counter() - began:.0f} s")
    if proven < len(rows):
        raise ValueError(f"{len(rows) - proven} of {len(rows)} minima could not be proven; the lines above say why")


def _prove_bound() -> None:
    """Checks the stored lower bound of planar costs."""
    began, certificate, boxes = time.perf_counter(), PlanarBound.stored(), 0
    task = make_task("stabilize")
    try:
        with progress_bar() as progress:
            bar = progress.add_task("bound of planar costs, %", total=100)
            for share, more, proven in check_parts(certificate):
                boxes += more
                progress.update(bar, completed=100 * share)
                if not proven:
                    raise ValueError(f"the bound is not proven: a box of {boxes} failed")
    except NoMachineCodeError as error:
        raise ValueError(f"the check of the bound needs a C compiler; install gcc or clang. {error}".strip()) from error
    a = certificate.schedule(task.steps)
    console.print(
        f"Proven: where V < {certificate.rho:g} and the bound max({a:.4f} V, V - {certificate.delta:g}) is at most "
        f"{certificate.rho - certificate.delta:.4f}, every successful episode of Stabilize in a vertical plane costs at "
        f"least this bound. {boxes} boxes, {time.perf_counter() - began:.0f} s",
        soft_wrap=True,
    )
    covered, ratio = _tightness(certificate, _STARTS)
    console.print(
        f"{covered:.1%} of the planar starts of the task have it. In {len(ratio)} of them it is {ratio.min():.1%} "
        f"to {ratio.max():.1%} of the cost of the optimum, {ratio.mean():.1%} on average.",
        soft_wrap=True,
    )
