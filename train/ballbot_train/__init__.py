"""Training, evaluation and the command line `ballbot`.

Everything that users need is imported from here. A module is imported only when one of its names is first used:

| name | what it is |
|---|---|
| `evaluate` | measures any policy or controller on the certified episodes, and returns its row for the leaderboard |
| `evaluate_fresh` | measures a policy on thousands of fresh episodes |
| `load_policy` | loads a policy file as a Controller with `predict` |
| `shipped_policies` | the policies that come with the package |
| `export_onnx` | writes a policy as an ONNX file |
| `export_c` | writes a policy or LQR as a C file, with the filter of a robot with wheels |
| `BallbotVecEnv`, `RslVecEnv` | batched environments for Stable-Baselines3 and rsl-rl |
| `RegretWrapper` | adds the regret of every episode to its `info` |
| `RegretCallback` | measures the regret of a Stable-Baselines3 model while it trains |
| `Playground` | the simulation behind `ballbot play`, for scripts |
| `certified_replay` | certified episodes of several controllers in one picture in 3D |
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ballbot_train.evaluation.counterparts import RegretWrapper
    from ballbot_train.evaluation.evaluate import evaluate
    from ballbot_train.evaluation.fresh import evaluate_fresh
    from ballbot_train.learning.callbacks import RegretCallback
    from ballbot_train.learning.rsl import RslVecEnv
    from ballbot_train.learning.sb3 import BallbotVecEnv
    from ballbot_train.policy.export_c import export_c
    from ballbot_train.policy.export_onnx import export_onnx
    from ballbot_train.policy.files import shipped_policies
    from ballbot_train.policy.network import load_policy
    from ballbot_train.report.replay import certified_replay
    from ballbot_train.report.simulation import Playground

__all__ = [
    "BallbotVecEnv",
    "Playground",
    "RegretCallback",
    "RegretWrapper",
    "RslVecEnv",
    "certified_replay",
    "evaluate",
    "evaluate_fresh",
    "export_c",
    "export_onnx",
    "load_policy",
    "shipped_policies",
]

_MODULES = {
    "BallbotVecEnv": "learning.sb3",
    "Playground": "report.simulation",
    "RegretCallback": "learning.callbacks",
    "RegretWrapper": "evaluation.counterparts",
    "RslVecEnv": "learning.rsl",
    "certified_replay": "report.replay",
    "evaluate": "evaluation.evaluate",
    "evaluate_fresh": "evaluation.fresh",
    "export_c": "policy.export_c",
    "export_onnx": "policy.export_onnx",
    "load_policy": "policy.network",
    "shipped_policies": "policy.files",
}


def __getattr__(name: str) -> Any:
    from ballbot_gym.lazy import exports  # not before it is needed: `ballbot --help` imports nothing

    return exports(__name__, _MODULES)(name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
