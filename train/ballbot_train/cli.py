"""The command line `ballbot`, whose commands are in `ballbot_train.commands`."""

import sys

import tyro
from rich.console import Console

from ballbot_gym.rollout import PlanError
from ballbot_train.commands import COMMANDS
from ballbot_train.commands.train import command_line


def main() -> None:
    """Runs the command line; errors a user can cause end with one line and exit status 1."""
    try:
        if sys.argv[1:2] == ["train"]:  # its options depend on the learner and the task
            command_line(sys.argv[2:])
            return
        tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="ballbot", description="Ballbot control, by its regret.")
    except (ValueError, TypeError, ImportError, PlanError, OSError) as error:
        Console(stderr=True).print(f"ballbot: {error}", style="red", markup=False)
        sys.exit(1)
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted; the same command continues where it stopped")
        sys.exit(130)


if __name__ == "__main__":
    main()
