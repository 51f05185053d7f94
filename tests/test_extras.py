"""What is not installed is named, with the extra that brings it."""

import re
import subprocess
import sys
from importlib.metadata import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def run(code, *blocked):
    """Runs code where some libraries cannot be imported; returns what it wrote."""
    start = f"import sys\nfor name in {blocked!r}:\n    sys.modules[name] = None\n"
    done = subprocess.run([sys.executable, "-c", start + code], capture_output=True, text=True)
    return done.stdout + done.stderr


MISSING = [  # in an order in which nothing imports what is missing later
    ("import gymnasium, ballbot_gym; gymnasium.make_vec('BallbotTurn-v0', compile=True)", "torch", "train"),
    (
        "import ballbot_gym, ballbot_baselines as b; b.CONTROLLERS['lqr'](ballbot_gym.TASKS['turn'](), None)",
        *("scipy", "baselines"),
    ),
    (
        "from ballbot_gym.trajectory import Trajectory; Trajectory([0, 1], [[0] * 8] * 2, [[0, 0]]).plot()",
        *("matplotlib", "train"),
    ),
    ("from ballbot_train.commands.play import play; play('turn', controller='lqr')", "websockets", "play"),
    (
        "from ballbot_train.work.executors import Workers, completed; list(completed([(0, int, ())], Workers(ray='local')))",
        *("ray", "ray"),
    ),
    ("from ballbot_train.commands.export import export; export('sac')", "onnxscript", "onnx"),
    (
        "from pathlib import Path; from ballbot_baselines.identification.formats import _bag; _bag(Path('drive'), {})",
        *("rosbags", "logs"),
    ),
]


def test_missing_library_names_its_extra():
    code = f"""
for code, library, extra in {MISSING!r}:
    sys.modules[library] = None
    try:
        exec(code)
    except (ImportError, SystemExit) as error:
        print(extra, library, "missing:", error)
    del sys.modules[library]
"""
    wrote = run(code)
    for _, library, extra in MISSING:
        (line,) = re.findall(rf"^{extra} {library} missing: .*", wrote, re.MULTILINE)
        assert f'pip install "ballbot-gym[{extra}]", or in a checkout pip install -e ".[{extra}]"' in line, wrote
        assert library in line.partition("missing:")[2]
        assert extra in metadata("ballbot-gym").get_all("Provides-Extra")


def test_a_command_without_the_library_of_commands_names_its_extra():
    wrote = run("sys.argv = ['ballbot', 'compare']\nfrom ballbot_train.cli import main\nmain()", "tyro")
    assert 'the commands need pip install "ballbot-gym[train]"' in wrote


def test_what_make_runs_on_every_python_is_collected_without_torch():
    names = re.search(r"^APPLY := .*\(addprefix tests/test_,(.*)\)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[1]
    paths = [str(ROOT / f"tests/test_{name}") for name in names.split()]
    wrote = run(f"import pytest\nprint('status', int(pytest.main(['--collect-only', '-q', *{paths!r}])))", "torch")
    assert "status 0" in wrote, wrote[-2000:]


EXTRAS = (
    *("casadi", "scipy", "matplotlib", "torch", "stable_baselines3", "minari", "tyro", "rich", "filelock"),
    *("tensorboard", "safetensors", "jinja2", "imageio", "h5py"),
)
"""What the extras bring."""


def test_every_module_that_cannot_be_imported_names_its_extra():
    code = """
import importlib.util
from pathlib import Path

for package in ("ballbot_gym", "ballbot_baselines", "ballbot_train"):
    folder = Path(importlib.util.find_spec(package).submodule_search_locations[0])
    for path in sorted(folder.rglob("*.py")):
        parts = (package, *path.relative_to(folder).with_suffix("").parts)
        name = ".".join(part for part in parts if part != "__init__")
        try:
            importlib.import_module(name)
            print("light", name)
        except (ImportError, SystemExit) as error:
            print("named" if "ballbot-gym[" in str(error) else "UNNAMED", name, error)
"""
    lines = run(code, *EXTRAS).splitlines()
    assert [line for line in lines if not line.startswith(("light ", "named "))] == []
    for name in ("ballbot_baselines.solvers.ocp", "ballbot_gym.vector.batch", "ballbot_train.learning.ppo"):
        assert any(line.startswith(f"named {name} ") for line in lines)
    for name in ("ballbot_gym.env", "ballbot_train"):
        assert f"light {name}" in lines


def test_without_an_engine_the_default_is_rk4_with_one_notice_and_others_say_how_to_get_them():
    code = (
        "import ballbot_gym, gymnasium\n"
        "names = {gymnasium.make(task.id).unwrapped.physics for task in ballbot_gym.TASKS.values()}\n"
        "print('physics', names)\n"
        "for physics in ('bullet', 'mujoco'):\n"
        "    try:\n        gymnasium.make('BallbotTurn-v0', physics=physics)\n"
        "    except ImportError as error:\n        print('refused', error)\n"
    )
    wrote = run(code, "pybullet", "mujoco")
    assert "physics {'rk4'}" in wrote
    assert wrote.count('Neither PyBullet nor MuJoCo is installed: physics="rk4" is used') == 1
    assert 'refused physics="mujoco" needs mujoco, which is not installed: pip install "ballbot-gym[mujoco]"' in wrote
    assert 'refused PyBullet is not installed. Get it with "pip install pybullet"' in wrote


def test_without_pybullet_mujoco_is_the_default_and_everything_works_without_a_warning():
    pytest.importorskip("mujoco")
    code = """
import warnings
warnings.simplefilter("error")
import gymnasium, numpy as np, ballbot_gym
from gymnasium.utils.env_checker import check_env
for task in ballbot_gym.TASKS.values():
    env = gymnasium.make(task.id, render_mode="rgb_array")
    env.reset(seed=0)
    env.step(np.zeros(2, np.float32))
    print(env.unwrapped.physics, env.render().shape)
    check_env(env.unwrapped)
    env.close()
"""
    wrote = run(code, "pybullet", "websockets")
    assert wrote.splitlines() == 4 * ["mujoco (480, 640, 3)"]
