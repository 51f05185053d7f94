"""Whether a policy that is trained for an identified robot is as good on the true robot as one that is trained for the truth.

    python benchmarks/identified_policies.py --robot rolling --tasks stabilize turn orbit --robots 4

For every robot that is drawn, a log of 60 s is recorded and identified; the masses of body and ball and the friction of the
floor are given. The learner of `ballbot train apg` then goes on from the shipped policy of the nominal robot, once for the
identified robot and once for the true one, with the same seed and settings. Both policies after the last iteration, and the
shipped one, run on the same fresh episodes of the true robot, without delay and noise. Regrets are means over those of the
first episodes whose optimum is found and in which neither trained policy fails, or for the shipped policy in which it does
not fail. Robots and tasks that are in the file of results are not repeated; robots and policies in the folder of the results
are used again.
"""

import argparse
import csv
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_baselines.identification.identify import identify
from ballbot_baselines.identification.logs import Log
from ballbot_baselines.identification.record import record
from ballbot_gym import files, named_robot, register_robot, urdf_text
from ballbot_gym.env import make_task
from ballbot_gym.robot import TRACKS
from ballbot_train.evaluation.fresh import FreshResult, evaluate_fresh
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.policy.files import shipped_policies
from ballbot_train.policy.network import PolicyNetwork

_KNOWN = ("body_mass", "ball_mass")
_TRIES = 100  # seeds are skipped whose robot falls under the controller of the nominal one


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="rolling")
    parser.add_argument("--tasks", nargs="+", default=["orbit", "turn"])
    parser.add_argument("--physics", default="mujoco")
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--start", default="apg", help="the shipped policy of the nominal robot")
    parser.add_argument("--iterations", type=int, default=200)
    parser.add_argument("--learning-rate", type=float, default=5e-4)
    parser.add_argument("--episode-seconds", type=float, default=4.0)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--optima", type=int, default=100)
    parser.add_argument("--out", type=Path, default=Path("runs/identified_policies"))
    options = parser.parse_args()
    table, rows, done = options.out / "identified_policies.csv", [], 0
    if table.exists():
        rows = list(csv.DictReader(table.read_text().splitlines()))
    for seed in range(_TRIES):
        if done == options.robots:
            break
        folder = options.out / f"{options.robot}_{options.physics}_{seed}"
        try:
            identified(options.robot, options.physics, seed, folder)
        except ValueError as error:
            print(f"{seed}: {error}", flush=True)
            continue
        done += 1
        for task in options.tasks:
            key = {"robot": options.robot, "physics": options.physics, "seed": str(seed), "task": task}
            if not any(all(row[name] == value for name, value in key.items()) for row in rows):
                rows.append(key | of_task(task, folder, options))
                files.write_csv(table, rows)
                print(", ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)


def identified(name: str, physics: str, seed: int, folder: Path) -> None:
    """Writes the URDF of a robot that is drawn, and of the robot that its log gives, to a folder.

    Raises:
        ValueError: the robot fell while it recorded the log.
    """
    if (folder / "identified.urdf").exists():
        return
    nominal: Any = named_robot(name)
    made = record(nominal, randomization=replace(TRACKS["real"], friction=(1.0, 1.0)), physics=physics, seed=seed)
    weighed = replace(nominal, **{each: getattr(made.robot, each) for each in _KNOWN})
    log = Log.read(Log.write(made.readings, folder / "log.csv"), weighed)
    found = identify(weighed, [log], _KNOWN).found.robot
    files.write(folder / "true.urdf", urdf_text(made.robot))
    files.write(folder / "identified.urdf", urdf_text(found))


def of_task(task: str, folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Successes and regrets on the true robot of the policies for the true, the identified and the nominal robot."""
    robots = {each: f"{folder.name}_{each}" for each in ("true", "identified")}
    policies = {"nominal": shipped_policies(make_task(task, options.robot), options.robot)[options.start]}
    for each, name in robots.items():
        register_robot(name, folder / f"{each}.urdf")
        policies[each] = trained(task, name, policies["nominal"], folder / f"{task}-{each}.json", options)
    true, problem = robots["true"], make_task(task, robots["true"])
    every = {
        name: evaluate_fresh(PolicyNetwork.load(policy, problem, None), task, options.episodes, robot=true)
        for name, policy in policies.items()
    }
    optima = every["true"].with_optima(options.optima, 1).optima
    kept = {name: np.isfinite(optima) & ~each.failure[: len(optima)] for name, each in every.items()}
    both = kept["true"] & kept["identified"]
    kept |= {"true": both, "identified": both}
    means = {name: mean_regret(each, optima, kept[name]) for name, each in every.items()}
    return {
        **{f"success_{name}": float(each.success.mean()) for name, each in every.items()},
        "episodes": options.episodes,
        **{f"regret_{name}": value for name, value in means.items()},
        "optima": int(both.sum()),
        "difference": means["identified"] - means["true"],
    }


def trained(task: str, robot: str, start: Path, out: Path, options: argparse.Namespace) -> Path:
    """The file of a policy that is trained for a robot, from another policy."""
    if not out.exists():
        problem, params = make_task(task, robot), named_robot(robot)
        settings = replace(
            LEARNERS["apg"].settings(task, warm=True),
            iterations=options.iterations,
            learning_rate=options.learning_rate,
            episode_seconds=options.episode_seconds,
        )
        begin = PolicyNetwork.load(start, problem, None)
        learner = LEARNERS["apg"].make(problem, params, settings, 0, start=begin)
        while learner.iteration < learner.iterations:
            learner.iterate()
        learner.network.save(out, {"training": {"learner": "apg", "settings": asdict(settings), "start": start.name}})
    return out


def mean_regret(result: FreshResult, optima: np.ndarray, counted: np.ndarray) -> float:
    return float((result.costs[: len(optima)] / optima - 1)[counted].mean())


if __name__ == "__main__":
    main()
