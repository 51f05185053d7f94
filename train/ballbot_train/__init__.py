"""Training, evaluation and the command line `ballbot`.

Short import paths that stay where they are; each imports what it needs when it is first used:

| name | what it is |
|---|---|
| `evaluate` | the leaderboard row of anything that acts: `ballbot_train.evaluation.evaluate.evaluate` |
| `evaluate_fresh` | thousands of fresh episodes of a policy: `ballbot_train.evaluation.fresh.evaluate_fresh` |
| `load_policy` | a policy file as a Controller with `predict`: `ballbot_train.policy.load_policy` |
| `shipped_policies` | the policies that come with the package: `ballbot_train.policy_files.shipped_policies` |
| `BallbotVecEnv` | batched environments for Stable-Baselines3: `ballbot_train.learning.sb3.BallbotVecEnv` |
| `RegretCallback` | the regret of an SB3 model while it trains: `ballbot_train.learning.callbacks.RegretCallback` |
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ballbot_train.evaluation.evaluate import evaluate as evaluate
    from ballbot_train.evaluation.fresh import evaluate_fresh as evaluate_fresh
    from ballbot_train.learning.callbacks import RegretCallback as RegretCallback
    from ballbot_train.learning.sb3 import BallbotVecEnv as BallbotVecEnv
    from ballbot_train.policy import load_policy as load_policy
    from ballbot_train.policy_files import shipped_policies as shipped_policies

_LAZY = {
    "evaluate": "ballbot_train.evaluation.evaluate:evaluate",
    "evaluate_fresh": "ballbot_train.evaluation.fresh:evaluate_fresh",
    "load_policy": "ballbot_train.policy:load_policy",
    "shipped_policies": "ballbot_train.policy_files:shipped_policies",
    "BallbotVecEnv": "ballbot_train.learning.sb3:BallbotVecEnv",
    "RegretCallback": "ballbot_train.learning.callbacks:RegretCallback",
}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from ballbot_gym.lazy import load

    return load(_LAZY[name])


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
