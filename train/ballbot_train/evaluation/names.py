"""Names of controllers in tables and in file names: unique, whatever names and paths users give."""

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from ballbot_gym.engines import PHYSICS
from ballbot_gym.robot import ROBOTS
from ballbot_gym.tasks.identity import digest

_PLAIN = re.compile("[a-z0-9]+(-[a-z0-9]+)*")
_DIGEST = 12  # hexadecimal digits
ARROW = " → "
"""Between the learners of a policy's way."""
_LONGEST = 60  # characters of a name that a file's name repeats


def file_part(name: str) -> str:
    """A part of a file's name that is unique to this name, also on file systems that ignore the case of letters.

    A name of small letters, digits and single hyphens is kept. Any other name, such as a path, is shortened and gets a
    digest of all of it. So does a name that ends like a digest, or that holds the name of a robot or an engine: file names
    hold these as well, and `stabilize-rolling-ppo` would be two things.
    """
    words = name.split("-")
    looks_like_digest = re.fullmatch(f"[0-9a-f]{{{_DIGEST}}}", words[-1]) is not None
    if (
        _PLAIN.fullmatch(name)
        and not looks_like_digest
        and not {*words} & {*ROBOTS, *PHYSICS}
        and len(name) <= _LONGEST
    ):
        return name
    path = Path(name)
    readable = re.sub("[^a-z0-9]+", "-", f"{path.parent.name}-{path.stem}".lower()).strip("-")[:_LONGEST]
    return f"{readable}-{digest(name)[:_DIGEST]}".strip("-")


def with_way(name: str, way: str) -> str:
    """A controller's name behind the learners that came before it on the way of its training: "dagger → apg → ppo".

    Args:
        name: of a shipped policy, such as "ppo" or "apg-late". Any other name stays as it is if there is no way.
        way: its whole way, see `policy.files.shipped_ways`.
    """
    before, arrow, _ = way.rpartition(ARROW)
    return f"{before}{arrow}{name}" if not Path(name).suffix else name


def shortened(names: Iterable[str]) -> dict[str, str]:
    """Each name as tables show it: of a path the shortest end that no other name has, and at least the file's name."""
    whole = list(dict.fromkeys(names))
    shown = {name: Path(name).parts[-1:] if Path(name).suffix else (name,) for name in whole}
    while True:
        counts = Counter(shown.values())
        longer = {name: Path(name).parts[-len(end) - 1 :] for name, end in shown.items() if counts[end] > 1}
        if all(shown[name] == end for name, end in longer.items()):
            return {name: str(Path(*end)) if Path(name).suffix else name for name, end in shown.items()}
        shown |= longer
