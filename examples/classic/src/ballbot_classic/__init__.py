"""Well-known systems as robots and tasks of ballbot-gym: their optima, and the regret of any policy.

Installed, the package is found by `import ballbot_gym`. From a checkout, `ballbot_classic.register()` does the same.
"""

from importlib import import_module

SYSTEMS = ("pendulum", "mountain_car", "cart_pole", "kelly", "acrobot")
"""Modules, of a system each."""


def register() -> None:
    """Registers the robot and the tasks of every system."""
    for name in SYSTEMS:
        import_module(f"ballbot_classic.{name}")
