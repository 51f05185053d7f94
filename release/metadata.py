"""Writes what sites that list software and data ask for, from the data itself: `make metadata`.

| file | for |
|---|---|
| .zenodo.json | Zenodo, which archives releases |
| docs/certified.croissant.json | the certified episodes as Croissant, which data search engines read |
| ballbot_gym/certified/scores.json | the scores that Minari's datasets are normalized by |
"""

import hashlib
import json
from pathlib import Path

import numpy as np
from version import PLACES, written

from ballbot_gym import BallbotEnv, certified, files
from ballbot_gym.robots import PAPER, named_robot
from ballbot_gym.rollout import ActionController, rollout
from ballbot_gym.tasks import SHIPPED

ROOT = Path(__file__).parent.parent
REPOSITORY = "https://github.com/ballbot-gym/ballbot-gym"
LICENSE = "https://opensource.org/license/mit"
ABOUT = "A Gymnasium benchmark for high-lean ballbot control in which every task's optimum is known."
KEYWORDS = ["ballbot", "benchmark", "gymnasium", "optimal control", "reinforcement learning", "trajectory optimization"]
ARRAYS = {
    "states": "initial states: x, y, two leans in m and rad, and their rates",
    "constants": "constants of the episodes, such as a commanded speed",
    "costs": "optimal costs",
    "durations": "durations of the optimal episodes in s",
    "violations": "largest constraint violations of the optima in SI units",
    "statuses": "how the solver ended",
    "x": "states of the stored optimal trajectories, one after the other",
    "u": "forces of the stored optimal trajectories in N, one after the other",
    "lengths": "numbers of control steps of the stored trajectories",
}
"""The arrays of a certified set, and what they hold."""


def zenodo() -> dict[str, object]:
    """The deposition of a release."""
    return {
        "title": "ballbot-gym: a benchmark for high-lean ballbot control with known optima",
        "description": ABOUT,
        "version": written("pyproject.toml", PLACES["pyproject.toml"]),
        "upload_type": "software",
        "access_right": "open",
        "license": "mit",
        "creators": [{"name": "ballbot-gym contributors"}],
        "keywords": KEYWORDS,
        "related_identifiers": [{"identifier": REPOSITORY, "relation": "isSupplementTo", "scheme": "url"}],
    }


def croissant() -> dict[str, object]:
    """The certified episodes of all robots, in Croissant 1.0."""
    objects = []
    for path in sorted(Path(certified.__file__).parent.glob("*.npz")):
        url = f"{REPOSITORY}/raw/main/{path.relative_to(ROOT).as_posix()}"
        objects.append(
            {
                "@type": "cr:FileObject",
                "@id": path.stem,
                "name": path.name,
                "description": f"Certified episodes {path.stem}, with {', '.join(ARRAYS)}.",
                "contentUrl": url,
                "contentSize": f"{path.stat().st_size} B",
                "encodingFormat": "application/x-npz",
                "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
            }
        )
    arrays = ", ".join(f"{name} ({text})" for name, text in ARRAYS.items())
    return {
        "@context": {
            "@vocab": "https://schema.org/",
            "sc": "https://schema.org/",
            "cr": "http://mlcommons.org/croissant/",
            "dct": "http://purl.org/dc/terms/",
            "conformsTo": "dct:conformsTo",
        },
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": "ballbot-gym-certified-episodes",
        "description": f"200 episodes for every robot and task of ballbot-gym with their optima. Arrays: {arrays}.",
        "url": REPOSITORY,
        "license": LICENSE,
        "version": written("pyproject.toml", PLACES["pyproject.toml"]),
        "citeAs": f"ballbot-gym contributors: ballbot-gym, {REPOSITORY}",
        "creator": {"@type": "sc:Organization", "name": "ballbot-gym contributors"},
        "datePublished": written("CITATION.cff", r"^date-released: (.*)$"),
        "keywords": KEYWORDS,
        "distribution": objects,
    }


def scores() -> dict[str, dict[str, float]]:
    """Mean returns on the certified episodes in the closed form: of uniformly random actions, and of the optima."""
    found = {}
    for kind in SHIPPED:
        env, rng = BallbotEnv(kind.id, physics="rk4"), np.random.default_rng(0)
        known = certified.load(kind.id, PAPER)
        controller = ActionController(env.task, named_robot(PAPER), lambda seen, begins, rng=rng: rng.uniform(-1, 1, 2))
        full = env.task.survival_reward * env.task.duration  # return + cost
        random = [full - rollout(env, controller, options=known.options(i)).cost for i in range(len(known))]
        optimal = full - known.costs
        found[kind.id] = {
            "ref_min_score": round(float(np.mean(random)), 3),
            "ref_max_score": round(float(np.mean(optimal)), 3),
        }
        env.close()
    return found


def main() -> None:
    for name, content in (
        (".zenodo.json", zenodo()),
        ("docs/certified.croissant.json", croissant()),
        ("ballbot_gym/certified/scores.json", scores()),
    ):
        files.write(ROOT / name, json.dumps(content, indent=2, ensure_ascii=False) + "\n")
        print(name)


if __name__ == "__main__":
    main()
