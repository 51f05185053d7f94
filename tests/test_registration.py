"""Tasks and robots of users: registered by a call or by an entry point, and known by name in every process."""

import math
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from typing import ClassVar

import gymnasium
import numpy as np
import pytest
import tomllib

from ballbot_baselines import LqrController
from ballbot_baselines.feedback.lqr import equilibrium_gain
from ballbot_gym import TASKS, Task, certified, files, named_robot, register_robot, register_task
from ballbot_gym.certified import cache
from ballbot_gym.env import make_task
from ballbot_gym.robot import ROBOTS, URDF_PATH, UrdfError, read_urdf, urdf_text
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_train.commands.new import new
from ballbot_train.evaluation import evaluate, optima


@pytest.fixture
def module(tmp_path, monkeypatch):
    """The name of a user's module, `ballbot_reach.py` in the folder of the test, which registers the task "reach"."""
    new("task", "reach", tmp_path, episodes=0)
    monkeypatch.syspath_prepend(tmp_path)
    return "ballbot_reach"


@pytest.fixture
def light(tmp_path):
    """The path of the URDF of a lighter robot."""
    path = tmp_path / "light.urdf"
    path.write_text(urdf_text(replace(named_robot("paper"), body_mass=10.0)))
    return path


def test_ours_are_registered_like_everybody_s():
    assert list(TASKS) == ["stabilize", "turn", "orbit", "weave"]
    assert list(ROBOTS) == ["paper", "rolling", "kugle", "omni", "omni_strong"]
    for name, kind in TASKS.items():
        assert gymnasium.spec(kind.id).kwargs == {"task": name}


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_user_s_task_is_made_in_worker_processes_of_every_start_method(module, method, tmp_path):
    # in a process of its own: this one has threads, which no fork copies
    code = (
        f"import gymnasium, numpy as np\n"
        f"from gymnasium.vector import AsyncVectorEnv\n"
        f"import {module}\n"
        f"if __name__ == '__main__':\n"
        f"    envs = gymnasium.make_vec('BallbotReach-v0', 2, vectorization_mode='async', physics='rk4',\n"
        f"                              vector_kwargs=dict(context={method!r}, shared_memory=False))\n"
        f"    seen, _ = envs.reset(seed=0)\n"
        f"    print(envs.step(np.zeros((2, 2), np.float32))[0].shape)\n"
        f"    envs.close()\n"
    )
    (tmp_path / "script.py").write_text(code)
    ran = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True)
    assert ran.stdout.strip() == "(2, 8)", ran.stderr


def test_gymnasium_imports_the_module_of_an_id(module):
    env = gymnasium.make(f"{module}:BallbotReach-v0", physics="rk4")
    assert env.unwrapped.task == TASKS["reach"]()
    assert (
        gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json())).unwrapped.task
        == TASKS["reach"]()
    )
    batch = gymnasium.make_vec(f"{module}:BallbotReach-v0", 3, vectorization_mode="vector_entry_point")
    assert batch.reset(seed=0)[0].shape == (3, 8)


def test_entry_points_are_found_where_the_package_is_installed(module, light, tmp_path):
    announced = tmp_path / "reach-0.1.dist-info"
    announced.mkdir()
    (announced / "METADATA").write_text("Metadata-Version: 2.1\nName: reach\nVersion: 0.1\n")
    (tmp_path / "light_robot.py").write_text(
        f"import ballbot_gym\ndef register():\n    ballbot_gym.register_robot('light', {str(light)!r})\n"
    )
    (announced / "entry_points.txt").write_text(
        "[ballbot_gym.tasks]\nreach = ballbot_reach:Reach\nbroken = no_such_module:Task\n"
        "[ballbot_gym.robots]\nlight = light_robot:register\n"
    )
    for first in ("ballbot_gym", module):  # whichever is imported first
        code = (
            f"import {first}, ballbot_gym; env = ballbot_gym.BallbotEnv('reach', 'rk4', robot='light'); print(env.task)"
        )
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        ran = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
        assert ran.stdout.startswith("Reach("), ran.stderr
        assert "reach: ballbot_gym.tasks 'broken' (no_such_module:Task) fails" in ran.stderr


def test_commands_take_a_module_and_a_urdf_and_compute_optima_in_workers(typed, module, light, interpreted):
    options = ("--controllers", "lqr", "--episodes", 2, "--physics", "rk4", "--workers", 2, "--out", "out")
    ended, printed = typed("benchmark", "--tasks", f"{module}:reach", "--robot", light, *options)
    assert ended == 0, printed
    known = certified.load("reach", "light", episodes=[0, 1])
    assert np.isfinite(known.costs[:2]).all()
    assert np.isnan(known.costs[2:]).all()


WRONG = {
    "no class": (lambda: register_task("eight"), TypeError, "takes a class that derives from ballbot_gym.Task"),
    "no methods": (lambda: register_task(type("Empty", (Task,), {})), TypeError, "Empty has no cost, draw_state, goal"),
    "a taken name": (
        lambda: register_task(type("Other", (Stabilize,), {"id": "Other-v0"}), "stabilize"),
        ValueError,
        "'stabilize' is taken by ballbot_gym.tasks.stabilize.Stabilize; give another",
    ),
    "a taken id": (
        lambda: register_task(type("Mine", (Stabilize,), {})),
        ValueError,
        "BallbotStabilize-v0 of Mine is taken",
    ),
    "no id": (
        lambda: register_task(type("Mine", (Stabilize,), {"id": "my id"})),
        ValueError,
        "must be an id of Gymnasium",
    ),
    "no dataclass": (
        lambda: register_task(
            type("Mine", (Stabilize,), {"id": "Mine-v0", "__annotations__": {"speed": float}, "speed": 1.0})
        ),
        TypeError,
        r"Mine.speed is not a field: decorate Mine with @dataclass\(frozen=True\)",
    ),
    "a taken robot": (lambda: register_robot("rolling", URDF_PATH), ValueError, "'rolling' is taken by another robot"),
    "fields": (lambda: register_robot("mine", URDF_PATH, {"turn": 3}), TypeError, "fields must be fields by task"),
    "an unknown name": (lambda: make_task("math:eight"), ValueError, "unknown task 'math:eight'; known: 'stabilize'"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_registered_says_what_to_do(name):
    call, kind, message = WRONG[name]
    before = dict(TASKS), dict(ROBOTS)
    with pytest.raises(kind, match=message):
        call()
    assert before == (TASKS, ROBOTS)


def test_a_cell_of_a_notebook_may_run_twice():
    def cell(weight):
        @register_task
        @dataclass(frozen=True)
        class Sprint(Stabilize):
            id: ClassVar[str] = "Sprint-v0"
            sprint_weight: float = weight

        return Sprint

    cell(1.0)
    again = cell(2.0)
    assert TASKS["sprint"] is again
    assert gymnasium.make("Sprint-v0", physics="rk4").unwrapped.task.sprint_weight == 2.0


@dataclass(frozen=True)
class Nearby(Stabilize):
    """Stabilize from nearer, with a weight that its cost takes from elsewhere."""

    id: ClassVar[str] = "Nearby-v0"
    start_speed: float = 1.0
    WEIGHT: ClassVar[list[float]] = [1.0]

    def cost(self, x, u, c):
        return self.WEIGHT[0] * super().cost(x, u, c)


@pytest.fixture
def counted(monkeypatch, interpreted):
    """Counts the optima that are computed."""
    from ballbot_baselines.optimum import certification

    find, starts = certification.find_optimum, []

    def counting(task, params, x, c, **options):
        starts.append(x)
        return find(task, params, x, c, **options)

    monkeypatch.setattr(certification, "find_optimum", counting)
    return starts


def test_optima_are_computed_once_and_say_how_they_were_found(counted):
    task = Nearby(duration=2.0)
    known = optima.known(task, "paper", [1, 3])
    again = optima.known(task, named_robot("paper"), [3, 1, 2])
    assert len(counted) == 3
    assert again.costs[[1, 3]].tolist() == known.costs[[1, 3]].tolist()
    assert np.isnan(known.costs[2])
    assert known.statuses[1] == "fatrop: Solve_Succeeded"
    assert known.violations[1] < 1e-6


def test_an_optimum_of_something_else_is_never_taken(monkeypatch):
    task, robot = Nearby(duration=2.0), named_robot("paper")
    folder = cache.folder(task, robot)
    others = [
        (replace(task, effort_weight=1e-3), robot),
        (task, replace(robot, friction=0.9)),
        (Stabilize(duration=2.0), robot),
    ]
    assert len({folder, *(cache.folder(*other) for other in others)}) == 4
    assert cache.folder(replace(task, survival_reward=50.0), robot) == folder
    monkeypatch.setattr(Nearby, "WEIGHT", [2.0])  # the same class and fields, and another cost
    cache._digest.cache_clear()
    assert cache.folder(task, robot) != folder


def test_a_stored_optimum_that_does_not_move_so_is_computed_again(counted):
    task, robot = Nearby(duration=2.0), named_robot("paper")
    cost = optima.known(task, robot, [0, 1]).costs[0]
    path, other = sorted(cache.folder(task, robot).glob("*.npz"))
    dearer = files.npz(files.read_npz(path) | {"costs": np.array([2 * cost])})
    for content in (b"garbage", dearer, other.read_bytes()):
        path.write_bytes(content)
        assert optima.known(task, robot, [0]).costs[0] == pytest.approx(cost, rel=1e-9)
    assert len(counted) == 5


def test_any_task_and_robot_has_a_row(counted):
    light = replace(named_robot("paper"), body_mass=12.0)
    row = evaluate.evaluate("lqr", Nearby(duration=4.0), 2, "rk4", robot=light)
    assert (row.task, row.falls) == ("nearby", 0)
    assert 0 <= row.regret_mean < 1


def test_a_goal_that_cannot_be_reached_names_the_methods_to_look_at(monkeypatch):
    from ballbot_baselines.optimum import certification

    def find_none(*problem, **options):  # which takes long to find out
        raise PlanError("no feasible episode")

    monkeypatch.setattr(certification, "find_optimum", find_none)
    far = type("Far", (Nearby,), {"first_exit": True, "id": "Far-v0"})
    with pytest.raises(
        PlanError, match=r"no optimum of Far-v0 for\nepisode 0: .*\n.*Far.goal can be reached .* guess_paths"
    ):
        optima.known(far(duration=0.4), "paper", [0])


FEW = ("--iterations", 1, "--evaluations", 1, "--num-envs", 4, "--batch-size", 96)
FEW += ("--test-episodes", 1, "--validation-episodes", 1)
"""Options of a training that only has to run."""


def check_package(folder):
    """The tests of a package pass, and ruff finds no fault in it."""
    for check in ("pytest -q", "ruff check .", "ruff format --check ."):
        ran = subprocess.run([sys.executable, "-m", *check.split()], cwd=folder, capture_output=True, text=True)
        assert ran.returncode == 0, ran.stdout


def entries_of(folder):
    """The tasks that a package announces, by name."""
    return tomllib.loads((folder / "pyproject.toml").read_text())["project"]["entry-points"]["ballbot_gym.tasks"]


def test_a_new_package_passes_its_own_tests(typed, tmp_path):
    ended, printed = typed("new", "task", "figure_eight", "--episodes", 1)
    assert ended == 0, printed
    folder = tmp_path / "figure_eight"
    assert "| figure_eight | trajopt | bullet | 100.0 % | 0/1 |" in (folder / "leaderboard.md").read_text()
    assert entries_of(folder) == {"figure_eight": "ballbot_figure_eight:FigureEight"}
    check_package(folder)
    assert typed("new", "task", "figure_eight")[0] == 1


def test_a_new_system_passes_its_own_tests(typed, tmp_path):
    ended, printed = typed("new", "system", "two_springs", "--episodes", 1)
    assert ended == 0, printed
    folder = tmp_path / "two_springs"
    assert "| two_springs | trajopt | rk4 | 100.0 % | 0/1 |" in (folder / "leaderboard.md").read_text()
    assert "ballbot play" not in (folder / "README.md").read_text()
    assert entries_of(folder) == {"two_springs": "ballbot_two_springs:TwoSpringsTask"}
    check_package(folder)
    assert typed("new", "system", "two_springs", "--out", "again")[0] == 1


@pytest.mark.slow
def test_commands_take_a_new_system(typed, tmp_path, monkeypatch):
    assert typed("new", "system", "two_rails", "--episodes", 0)[0] == 0
    monkeypatch.syspath_prepend(tmp_path / "two_rails")
    name = "ballbot_two_rails:two_rails"
    for command in (
        ("optimize", name),
        ("benchmark", "--tasks", name, "--controllers", "nmpc", "--episodes", 1),
        ("evaluate", "lqr", "--task", name, "--episodes", 1),
        ("replay", name, "--controllers", "lqr", "--frames", 1),
        ("demos", "--task", name, "--expert", "lqr", "--episodes", 1),
        ("train", "ppo", "--task", name, *FEW),
    ):
        ended, printed = typed(*command)
        assert ended == 0, f"{command[0]}: {printed}"
    ended, printed = typed("play", name)
    assert (ended, "the page draws ballbots" in printed) == (1, True)


@pytest.mark.parametrize("kind", ["task", "system"])
@pytest.mark.parametrize("name", ["turn", "My Task", "../x"])
def test_a_new_package_needs_a_name_of_its_own(kind, name, typed, tmp_path):
    assert typed("new", kind, name)[0] == 1
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("kind", "name"),
    [("task", name) for name in ("none", "true", "reference", "any", "value_error", "gym", "turn_")]
    + [("system", name) for name in ("none", "true", "quantity", "robot", "task", "gym", "kugle")],
)
def test_a_new_package_has_a_class_and_a_module_that_nothing_else_has(kind, name, typed, tmp_path):
    ended, printed = typed("new", kind, name)
    assert (ended, "give another name" in printed) == (1, True), printed
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("file", ["2024-ballbot.urdf", "Löwe.urdf", "_x.urdf"])
def test_every_name_of_a_robot_s_file_will_do(file, typed, light, tmp_path):
    light.rename(tmp_path / file)
    words = "--task stabilize --format c --out lqr.c --robot"
    ended, printed = typed("export", "lqr", *words.split(), file)
    assert ended == 0, printed


def test_a_payload_on_a_fixed_joint_is_refused(light):
    text = light.read_text()
    payload = (
        '<link name="payload"><inertial><mass value="3"/></inertial></link><joint name="holds" type="fixed">'
        '<parent link="body"/><child link="payload"/></joint></robot>'
    )
    light.write_text(text.replace("</robot>", payload))
    with pytest.raises(UrdfError, match=r"link 'payload' has a mass.*add its mass.*to link 'body'"):
        register_robot("laden", light)
    light.write_text(text.replace("</robot>", '<link name="camera"/></robot>'))
    assert read_urdf(light).body_mass == 10.0


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("import no_such_library", "imports 'no_such_library', which is not installed"),
        ("raise SystemExit(3)", "exits when it is imported"),
    ],
)
def test_a_module_that_cannot_be_imported_is_blamed_itself(line, message, typed, tmp_path):
    module = f"faulty_{line.partition(' ')[0]}"
    (tmp_path / f"{module}.py").write_text(line)
    ended, printed = typed("evaluate", "lqr", "--task", f"{module}:mine")
    assert ended == 1
    assert message in printed
    assert "pip install" not in printed


def test_a_plugin_that_exits_does_not_end_the_import(tmp_path):
    (tmp_path / "exits.py").write_text("raise SystemExit(3)")
    folder = tmp_path / "exits-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: exits\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[ballbot_gym.tasks]\nmine = exits:Mine\n")
    ran = subprocess.run(
        [sys.executable, "-c", "import ballbot_gym; print('imported')"], cwd=tmp_path, capture_output=True, text=True
    )
    assert ran.stdout.strip() == "imported"
    assert "exits: ballbot_gym.tasks 'mine' (exits:Mine) fails: SystemExit(3)" in ran.stderr


def test_lqr_without_a_gain_fails_its_episodes_and_says_why(interpreted):
    flat = type(
        "Flat", (Stabilize,), {"id": "Flat-v0", "cost": lambda self, x, u, c: 1.0 + 1e-5 * (u[0] ** 2 + u[1] ** 2)}
    )
    task, robot = flat(duration=2.0), named_robot("paper")
    with pytest.raises(PlanError, match=r"LQR of Flat-v0 has no gain.*Flat.cost must grow"):
        LqrController(task, robot).reset(0.0, np.zeros(8), np.zeros(0))
    assert equilibrium_gain(task, robot) is None


FAULTS = {
    "None": ({"cost": lambda self, x, u, c: None}, r"Wrong.cost gives None .*with `return`"),
    "zero": ({"cost": lambda self, x, u, c: 0.0 * u[..., 0]}, "Wrong.cost gives 0 for every state and force"),
    "random": ({"cost": lambda self, x, u, c: np.random.rand()}, r"Wrong.cost gives .* for the same x, u and c"),
    "seven": ({"draw_state": lambda self, z, c, params: (0.0,) * 7}, "Wrong.draw_state gives 7 numbers"),
    "random start": (
        {"draw_state": lambda self, z, c, params: (*np.random.rand(2) / 10, *(0.0,) * 6)},
        "Wrong.draw_state gives other states for the same z",
    ),
    "sample": ({"sample": lambda self, rng, params: (np.zeros(8), np.zeros(0))}, "Wrong.sample is never called"),
    "no guess": ({"guess_paths": lambda self, x, c, params: []}, r"Wrong.guess_paths gives \[\] .*at least one"),
    "unnamed": (
        {"margins": lambda self, x, c: (1.0, 1.0)},
        "Wrong.margins gives 2 limits, and margin_names names 1",
    ),
    "goal": ({"goal": lambda self, x, c: x[..., 0]}, "Wrong.goal gives .*give a tuple"),
    "observation": ({"observe": lambda self, x, c: x[..., :3]}, r"Wrong.observe gives the shape \(3,\)"),
    "NaN": ({"cost": lambda self, x, u, c: math.nan * x[..., 0]}, r"Wrong.cost gives nan without force"),
    "negative": ({"cost": lambda self, x, u, c: -u[..., 0]}, r"Wrong.cost gives -0 without force and -35 with one"),
    "start": (
        {"draw_state": lambda self, z, c, params: (0.0, 0.0, 1.5, *(0.0,) * 5)},
        "Wrong.draw_state .* the limit of tilt",
    ),
    "guess": (
        {"guess_paths": lambda self, x, c, params: [np.zeros((5, 3))]},
        r"Wrong.guess_paths gives the shape \(5, 3\)",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_task_that_no_optimizer_can_use_is_refused_by_the_name_of_its_method(name):
    methods, message = FAULTS[name]
    task = type("Wrong", (Stabilize,), {"id": "Wrong-v0", **methods})()
    with pytest.raises(ValueError, match=message):
        optima.known(task, "paper", [0])
    if name not in ("start", "guess", "no guess"):  # which depend on the robot
        before = dict(TASKS)
        with pytest.raises(ValueError, match=message):
            register_task(type(task), "wrong")
        assert before == TASKS


def test_a_task_is_known_by_its_id_wherever_its_name_is(make_env):
    for name, kind in TASKS.items():
        assert make_task(kind.id) == make_task(name)
    assert make_env("BallbotTurn-v0", physics="rk4").task == make_task("turn")
    assert evaluate.evaluate(lambda seen: np.zeros(2), "BallbotTurn-v0", 1, "rk4").task == "turn"
    with pytest.raises(ValueError, match="unknown task 'BallbotNone-v0'"):
        make_task("BallbotNone-v0")


def test_pybullet_is_another_name_of_bullet(make_env):
    pytest.importorskip("pybullet")
    env = make_env(physics="pybullet")
    assert env.physics == "bullet"
    assert evaluate.evaluate(lambda seen: np.zeros(2), "turn", 1, "pybullet").physics == "bullet"
    assert gymnasium.make("BallbotTurn-v0", physics="pybullet").unwrapped.physics == "bullet"
