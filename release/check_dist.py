"""Installs what is in dist/ as strangers do, outside of the repository, and uses it without a compiler and without a home.

python release/check_dist.py DIST
"""

import os
import re
import subprocess
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).parent.parent

ALONE = """
import time, warnings
warnings.simplefilter("error")
import gymnasium, numpy as np
from gymnasium.utils.env_checker import check_env
import ballbot_gym
from ballbot_gym import certified
from ballbot_gym.machine_code.single import StepCode
from ballbot_train import evaluate

for task in ballbot_gym.TASKS.values():
    env = gymnasium.make(task.id)
    check_env(env.unwrapped)
    envs = gymnasium.make_vec(task.id, num_envs=16384)
    envs.reset(seed=0)
    actions, begin = envs.action_space.sample(), time.perf_counter()
    for _ in range(10):
        observations, rewards, *_ = envs.step(actions)
        assert np.isfinite(observations).all() and np.isfinite(rewards).all()
    speed = 10 * 16384 / (time.perf_counter() - begin)
    code = StepCode.compiled(env.unwrapped.step_problem, env.unwrapped.params)
    optima = certified.load(task(), ballbot_gym.default_params())
    row = evaluate(lambda observation: np.zeros(2), env.unwrapped.task, episodes=2)
    kinds = f"{type(code).__name__}, {type(envs.unwrapped.batch).__name__}"
    counts = f"{len(optima.costs)} optima, {row.episodes} episodes"
    print(f"{task.id}: {env.unwrapped.physics}, {kinds} {speed:,.0f} steps/s, {counts}")
try:
    evaluate("lqr", episodes=2)
except ModuleNotFoundError as error:
    assert 'pip install "ballbot-gym[baselines]"' in str(error), error
else:
    raise SystemExit("the experts ran without their extra")
import sys
learners = {"torch", "casadi", "scipy"} & set(sys.modules)
assert not learners, learners
"""
"""What an installation without extras does."""

LAYERS = """
from ballbot_train.policy.layers import with_compiled_layers
from ballbot_train.policy.network import PolicyNetwork
from ballbot_train.policy.files import PolicySpec
network = PolicyNetwork(PolicySpec("", 8, (16,)))
assert with_compiled_layers(network) is not network, "compiled layers of policies are missing or unused"
"""
"""Whether the wheel with compiled code brings that of policies."""


class Stranger:
    """A new virtual environment outside of the repository, with one distribution and some extras."""

    def __init__(self, distribution: Path, extras: str, folder: Path):
        self.folder = folder
        self.python = folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
        subprocess.run([sys.executable, "-m", "venv", str(folder / "venv")], check=True)
        wanted = [f"ballbot-gym{extras} @ {distribution.resolve().as_uri()}", "-c", str(ROOT / "constraints.txt")]
        if extras == "[train]":
            wanted.append(
                f"torch=={metadata.version('torch')}"
            )  # as it is here: there may be a small one for processors alone
        install = [str(self.python), "-m", "pip", "install", "--quiet", "--no-compile"]
        if distribution.suffix == ".gz":
            install.append("--no-cache-dir")  # which may hold a wheel that was built from an older file of this name
        subprocess.run([*install, *wanted], check=True, cwd=folder)
        # A folder below a file can be made by nobody, not even by root.
        (folder / "file").touch()
        kept = {name: os.environ[name] for name in ("SYSTEMROOT", "TEMP", "TMP", "LANG") if name in os.environ}
        self.environment = {**kept, "PATH": str(self.python.parent), "HOME": str(folder / "file" / "home")}
        self.environment["USERPROFILE"] = self.environment["HOME"]

    def run(self, *command: str, code: str | None = None) -> str:
        """Output of a program of the environment, which gets code as its input.

        Raises:
            SystemExit: it failed; its output is printed.
        """
        begin = time.perf_counter()
        program = self.python.with_name(command[0])
        done = subprocess.run(
            [str(program), *command[1:]],
            input=code, capture_output=True, text=True, cwd=self.folder, env=self.environment, check=False,
        )  # fmt: skip
        print(f"    {' '.join(command)}: {time.perf_counter() - begin:.0f} s", flush=True)
        if done.returncode != 0:
            sys.exit(f"{done.stdout[-3000:]}{done.stderr[-3000:]}\nfailed: {command}")
        return done.stdout


def ten_lines() -> str:
    """README's ten lines."""
    return re.search(r"## Ten lines of code\n\n```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]  # type: ignore[index]


def check(distribution: Path, extras: str) -> None:
    """Installs a distribution and uses what its extras bring."""
    print(f"{distribution.name}{extras}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        stranger = Stranger(distribution, extras, Path(folder))
        assert "measure:" in stranger.run("ballbot", "--help")
        stranger.run("ballbot", "--version")
        if not extras:
            print(said := stranger.run("python", "-", code=ALONE), end="")
            if distribution.suffix == ".whl" and not distribution.stem.endswith("-any"):  # it brings compiled code
                assert said.count("StepCode, BallbotNative") == said.count("\n"), "compiled code is missing or unused"
        if extras == "[baselines]":
            print(stranger.run("python", "-", code=ten_lines()), end="")
        if extras == "[train]":
            stranger.run("python", "-", code=LAYERS)
            stranger.run("ballbot", "benchmark", "--episodes", "2")
            assert (stranger.folder / "runs/benchmark/report.html").exists()
        assert not (stranger.folder / "file" / "home").exists()


def main() -> None:
    """Checks all that lies in a folder."""
    dist = Path(sys.argv[1])
    (source,) = dist.glob("*.tar.gz")
    (universal,) = dist.glob("*-py3-none-any.whl")
    (compiled,) = set(dist.glob("*.whl")) - {universal}
    for distribution in (source, universal, compiled):
        check(distribution, "")
    check(universal, "[baselines]")
    check(compiled, "[baselines]")
    check(compiled, "[train]")
    print("dist: all checks passed")


if __name__ == "__main__":
    main()
