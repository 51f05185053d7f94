"""The name and the colour of each controller, the same in every figure, film and page."""

from pathlib import Path

COLORS = {
    "lqr": "#c0392b",
    "trajopt": "#1f6fb2",
    "nmpc": "#e08a00",
    "nmpc-offset-free": "#f2c14e",
    "dagger": "#34495e",
    "ppo": "#2e8b57",
    "sac": "#17a2b8",
    "shac": "#8e44ad",
}
LABELS = {
    "lqr": "LQR",
    "trajopt": "trajectory optimization + TVLQR",
    "nmpc": "NMPC",
    "nmpc-offset-free": "NMPC, offset-free",
    "dagger": "DAgger",
    "ppo": "PPO",
    "sac": "SAC",
    "shac": "SHAC",
}
YOU = "#e8590c"
"""The colour of a human."""
OPTIMUM = "#d4a017"
"""The colour of a robot that drives along the optimum."""
_OTHER_COLORS = ("#6b8e23", "#b9770e", "#5d6d7e", "#d35479")


def color(controller: str, i: int) -> str:
    """The colour of a controller; a controller without one of its own gets the `i`-th of the other colours."""
    return COLORS.get(controller, _OTHER_COLORS[i % len(_OTHER_COLORS)])


def label(controller: str) -> str:
    """The name of a controller in figures; a policy file is named after its file."""
    stem = Path(controller).stem
    return LABELS.get(stem, stem)
