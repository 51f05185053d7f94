"""The name and the colour of each controller, the same in every figure, film and page."""

from pathlib import Path

_CONTROLLERS = {
    "lqr": ("LQR", "#c0392b"),
    "trajopt": ("trajectory optimization + TVLQR", "#1f6fb2"),
    "nmpc": ("NMPC", "#e08a00"),
    "nmpc-offset-free": ("NMPC, offset-free", "#f2c14e"),
    "dagger": ("DAgger", "#34495e"),
    "ppo": ("PPO", "#2e8b57"),
    "sac": ("SAC", "#17a2b8"),
    "apg": ("APG", "#8e44ad"),
    "shac": ("SHAC", "#8e44ad"),
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


def label(controller: str) -> str:
    """The name of a controller in figures; a policy file is named after its file and the file's folder."""
    path = Path(controller)
    stem = f"{path.parent.name}/{path.stem}" if path.suffix and path.parent.name else path.stem
    return _CONTROLLERS.get(stem, (stem, ""))[0]
