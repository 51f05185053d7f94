"""The name and the colour of each controller, the same in every figure, film and page."""

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

from ballbot_train.evaluation.names import ARROW, shortened, with_way

_CONTROLLERS = {
    "lqr": ("LQR", "#c0392b"),
    "trajopt": ("trajectory optimization + TVLQR", "#1f6fb2"),
    "nmpc": ("NMPC", "#e08a00"),
    "nmpc-offset-free": ("NMPC, offset-free", "#f2c14e"),
    "dagger": ("DAgger", "#34495e"),
    "ppo": ("PPO", "#2e8b57"),
    "sac": ("SAC", "#17a2b8"),
    "apg": ("APG", "#8e44ad"),
    "ppo-scratch": ("PPO from scratch", "#9acd32"),
    "sac-scratch": ("SAC from scratch", "#7fd6e3"),
}
ORDER = [name for name, _ in _CONTROLLERS.values()]
"""Names as figures list them."""
YOU = "#e8590c"
"""The colour of a human."""
OPTIMUM = "#d4a017"
"""The colour of a robot that drives along the optimum."""
_OTHER_COLORS = ("#6b8e23", "#b9770e", "#5d6d7e", "#d35479")


def color(controller: str, i: int = 0) -> str:
    """The colour of a controller; a controller without one of its own gets the `i`-th of the other colours."""
    return _CONTROLLERS.get(controller, ("", _OTHER_COLORS[i % len(_OTHER_COLORS)]))[1]


def label(controller: str, way: str = "") -> str:
    """The name of a controller in figures; a policy file is named after its file and the file's folder.

    A shipped policy has the whole way of its training, if it is given.
    """
    path = Path(controller)
    stem = f"{path.parent.name}/{path.stem}" if path.suffix and path.parent.name else path.stem
    return ARROW.join(_CONTROLLERS.get(part, (part, ""))[0] for part in with_way(stem, way).split(ARROW))


def labels(controllers: Iterable[str], task: str = "", ways: Mapping[str, str] = {}) -> dict[str, str]:
    """The label of each controller of a figure, by its name. No two are the same: then of paths more is shown.

    Args:
        controllers: their names.
        task: of the figure.
        ways: the whole ways of shipped policies by "TASK/NAME".
    """
    found = {name: label(name, ways.get(f"{task}/{name}", "")) for name in controllers}
    short, counts = shortened(found), Counter(found.values())
    found = {name: short[name] if counts[text] > 1 else text for name, text in found.items()}
    return found if len(set(found.values())) == len(found) else dict(zip(found, found, strict=True))
