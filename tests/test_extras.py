"""What is not installed is named, with the extra that brings it."""

import subprocess
import sys

import pytest


def run(code, *blocked):
    """Runs code where some libraries cannot be imported; returns what it wrote."""
    start = f"import sys\nfor name in {blocked!r}:\n    sys.modules[name] = None\n"
    done = subprocess.run([sys.executable, "-c", start + code], capture_output=True, text=True)
    return done.stdout + done.stderr


@pytest.mark.parametrize(
    ("code", "library", "extra"),
    [
        ("import gymnasium, ballbot_gym; gymnasium.make_vec('BallbotTurn-v0')", "torch", "train"),
        ("from ballbot_gym.batch import BallbotBatch", "torch", "train"),
        ("from ballbot_baselines import find_optimum", "casadi", "baselines"),
        (
            "import ballbot_gym, ballbot_baselines as b; b.CONTROLLERS['lqr'](ballbot_gym.TASKS['turn'](), None)",
            "scipy",
            "baselines",
        ),
        ("from ballbot_train import BallbotVecEnv", "stable_baselines3", "train"),
        ("from ballbot_train import load_policy", "safetensors", "train"),
        ("from ballbot_train.cli import main", "rich", "train"),
        ("from ballbot_train.commands.export import export; export('sac')", "onnxscript", "onnx"),
    ],
)
def test_missing_library_names_its_extra(code, library, extra):
    assert f'pip install "ballbot-gym[{extra}]"' in run(code, library)


def test_without_pybullet_the_default_is_rk4_with_one_notice_and_bullet_says_how_to_get_it():
    code = (
        "import ballbot_gym, gymnasium\n"
        "names = {gymnasium.make(task.id).unwrapped.physics for task in ballbot_gym.TASKS.values()}\n"
        "print('physics', names)\n"
        "try:\n    gymnasium.make('BallbotTurn-v0', physics='bullet')\n"
        "except ImportError as error:\n    print('refused', error)\n"
    )
    wrote = run(code, "pybullet")
    assert "physics {'rk4'}" in wrote
    assert wrote.count('PyBullet is not installed: physics="rk4" is used') == 1
    assert 'refused PyBullet is not installed. Get it with "pip install pybullet"' in wrote


def test_with_pybullet_the_default_is_bullet():
    pytest.importorskip("pybullet")
    assert "bullet" in run("import ballbot_gym; print(ballbot_gym.BallbotEnv().physics)")
