"""Controllers as C files: compiled, they act as Python's do, and drive the same episodes to the same ends."""

import ctypes
import subprocess

import numpy as np
import pytest
from builders import random_policy, task_and_robot

from ballbot_gym import certified, machine_code
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import Sensors, default_params
from ballbot_gym.rollout import rollout
from ballbot_train.commands.export import export
from ballbot_train.evaluation.controllers import ControllerName
from ballbot_train.policy.export_c import LARGEST_ERROR, LQR, export_c
from ballbot_train.policy.files import SHIPPED
from ballbot_train.policy.network import PolicyController

COMPILER = machine_code.compiler()
pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler")
STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic")
SHIPPED_NAMES = sorted(  # the filter in front of informed policies is not exported
    path.stem for path in SHIPPED.glob("*.json") if "-informed-" not in path.stem
)


def built(source, made, *flags):
    subprocess.run([COMPILER, *STRICT, *flags, str(source), "-o", str(made), "-lm"], check=True)
    return made


class Compiled:
    """A C file as a Controller that compares its forces with those of Python's controller on the way."""

    def __init__(self, source, task, python):
        self._code = ctypes.CDLL(str(built(source, source.with_suffix(".so"), "-fPIC", "-shared")))
        self._python, self._limit, self.error = python, default_params().force_limit, 0.0
        self._observation = np.zeros(len(task.observation_scale), np.float32)

    def reset(self, t, x, c):
        self._c = np.array([*c, 0.0], np.float32)  # ctypes has no pointer to nothing
        self._code.ballbot_reset()
        self._python.reset(t, x, c)

    def act(self, t, x):
        action = np.zeros(2, np.float32)
        state, constants, seen, found = (
            part.ctypes.data_as(ctypes.c_void_p) for part in (x.astype(np.float32), self._c, self._observation, action)
        )
        self._code.ballbot_observe(state, constants, ctypes.c_float(t), seen)
        self._code.ballbot_act(seen, found)
        expected = np.clip(self._python.act(t, x) / self._limit, -1, 1)
        self.error = max(self.error, float(np.abs(action - expected).max()))
        return self._limit * action.astype(np.float64)


@pytest.mark.parametrize(
    ("task", "name"),
    [
        ("stabilize", "lqr"),
        ("turn", "ppo"),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in (("stabilize", "sac"), ("orbit", "sac"), ("weave", "ppo"))
        ),
    ],
)
def test_a_compiled_controller_drives_certified_episodes_to_the_same_ends(task, name, tmp_path):
    made = ControllerName(name).make(make_task(task), default_params())
    export(name, task=task, format="c", out=tmp_path / "controller.c")
    task = make_task(task)
    compiled = Compiled(tmp_path / "controller.c", task, made)
    env, episodes = BallbotEnv(task, physics="rk4"), certified.load(task, default_params())
    ends = []
    for i in range(8):
        driven, own = (rollout(env, each, options=episodes.options(i)) for each in (compiled, made))
        ends.append(driven.success)
        assert (driven.success, driven.failure) == (own.success, own.failure)
    assert any(ends)
    assert compiled.error < LARGEST_ERROR


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "orbit-apg-late" else pytest.mark.slow) for name in SHIPPED_NAMES]
)
def test_every_shipped_policy_passes_the_test_in_its_file(name, tmp_path):
    task, robot = task_and_robot(name)
    export(str(SHIPPED / f"{name}.json"), task=task, format="c", out=tmp_path / "policy.c", robot=robot)
    told = subprocess.run([built(tmp_path / "policy.c", tmp_path / "policy", "-DBALLBOT_TEST")], capture_output=True)
    assert told.returncode == 0
    assert told.stdout.startswith(b"PASS")


class FromSensors:
    """A C file with the filter as a Controller of an env that shows sensors."""

    senses = True

    def __init__(self, source, limit):
        self._code, self._limit = ctypes.CDLL(str(built(source, source.with_suffix(".so"), "-fPIC", "-shared"))), limit
        self._state, self._seen, self._action = (np.zeros(size, np.float32) for size in (11, 12, 3))

    def reset(self, t, x, c):
        self._code.ballbot_reset()
        self._begun = False

    def act(self, t, x):
        sensors, place = (part.astype(np.float32) for part in (x[:9] * Sensors.SCALE, x[9:11]))
        pointers = (
            part.ctypes.data_as(ctypes.c_void_p) for part in (sensors, place, self._state, self._seen, self._action)
        )
        sensors, place, state, seen, action = pointers
        code, begun, self._begun = self._code, self._begun, True
        estimate, more = (code.ballbot_estimate, action) if begun else (code.ballbot_first_estimate, place)
        estimate(sensors, more, state)
        self._code.ballbot_observe(state, None, ctypes.c_float(t), seen)
        self._code.ballbot_act(seen, action)
        return self._limit * self._action.astype(np.float64)


@pytest.mark.parametrize(
    ("name", "robot", "episodes"),
    [("apg-ekf", "omni_strong", 1), pytest.param("lqr-ekf", "omni", 20, marks=pytest.mark.slow)],
)
def test_a_compiled_filter_drives_certified_episodes_from_sensors_to_the_same_ends(name, robot, episodes, tmp_path):
    export(name, task="stabilize", format="c", out=tmp_path / "filtered.c", robot=robot)
    told = subprocess.run([built(tmp_path / "filtered.c", tmp_path / "test", "-DBALLBOT_TEST")], capture_output=True)
    assert told.stdout.startswith(b"PASS")
    env = BallbotEnv(robot=robot, physics="rk4", observation="sensors")
    compiled, known = FromSensors(tmp_path / "filtered.c", env.params.force_limit), certified.load(env.task, robot)
    made, ends = ControllerName(name).make(env.task, env.params), []
    for i in range(episodes):
        driven, own = (rollout(env, each, seed=i, options=known.options(i)) for each in (compiled, made))
        ends.append(driven.success)
        assert (driven.success, driven.failure) == (own.success, own.failure)
        assert driven.cost == pytest.approx(own.cost, rel=1e-3)
    assert any(ends)


@pytest.mark.parametrize(
    ("task", "fields"),
    [
        ("orbit", {"frame": "radial", "squash": "tanh_in_frame", "centred": True, "history": 2}),
        ("weave", {"frame": "fine_slalom", "squash": "clip", "centred": True, "activation": "relu"}),
        ("weave", {"frame": "routed_slalom", "routes": (8,), "activation": "silu"}),
        ("stabilize", {"mirrors": True, "odd": True, "linear": False, "squash": "clip", "history": 3}),
    ],
)
def test_all_that_a_policy_can_do_is_in_the_file(task, fields, tmp_path):
    task = make_task(task)
    network = random_policy(task, (8, 6), **fields)
    policy = network.save(tmp_path / "mine", {"training": {"learner": "a */ b *\\\n/ c"}})
    source = export_c(policy, tmp_path / "mine.c", task)
    compiled = Compiled(source, task, PolicyController(task, default_params(), network))
    rollout(BallbotEnv(task, physics="rk4"), compiled, seed=1)
    assert compiled.error < LARGEST_ERROR


def test_the_declarations_alone_can_be_included(tmp_path):
    export_c(LQR, tmp_path / "lqr.c", make_task("stabilize"))
    main = tmp_path / "main.c"
    main.write_text(
        '#define BALLBOT_HEADER\n#include "lqr.c"\n'
        "int main(void) { float state[8] = {1}, seen[BALLBOT_OBSERVATIONS], action[2]; ballbot_reset();\n"
        "    ballbot_observe(state, 0, 0, seen); ballbot_act(seen, action); return action[0] > 0 ? 0 : 1; }\n"
    )
    subprocess.run([built(main, tmp_path / "main", str(tmp_path / "lqr.c"))], check=True)


def test_lqr_that_differs_from_episode_to_episode_is_refused(tmp_path):
    with pytest.raises(ValueError, match="export a policy"):
        export_c(LQR, tmp_path / "lqr.c", make_task("turn"))


@pytest.mark.parametrize("flags", [(), ("-ffast-math",)], ids=str)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_a_state_that_is_no_number_gives_no_force_and_a_flag(bad, flags, tmp_path):
    task = make_task("orbit")
    network = random_policy(task, (8,), history=2)
    source = export_c(network.save(tmp_path / "mine", {}), tmp_path / "mine.c", task)
    code = ctypes.CDLL(str(built(source, tmp_path / "mine.so", "-fPIC", "-shared", *flags)))
    pointer = np.ctypeslib.ndpointer(np.float32)
    code.ballbot_observe.argtypes, code.ballbot_act.argtypes = (
        (pointer, pointer, ctypes.c_float, pointer),
        (pointer,) * 2,
    )
    c = certified.load(task, default_params()).constants[0].astype(np.float32)
    seen, action = np.zeros(len(task.observation_scale), np.float32), np.zeros(2, np.float32)

    def acts(state, constants=c, t=0.0):
        code.ballbot_observe(state, constants, t, seen)
        return code.ballbot_act(seen, action), action.tolist()

    good = np.full(8, 0.1, np.float32)
    code.ballbot_reset()
    first = acts(good)
    assert first[0] == 0
    for i in range(8):
        state = good.copy()
        state[i] = bad
        assert acts(state) == (1, [0.0, 0.0])
    assert acts(good, np.full_like(c, bad)) == (1, [0.0, 0.0])
    assert acts(good, t=bad) == (1, [0.0, 0.0])
    assert acts(good) == first  # its history is forgotten


@pytest.fixture(scope="module")
def filtered(tmp_path_factory):
    """The library of LQR behind a filter, for the robot with wheels."""
    folder = tmp_path_factory.mktemp("filtered")
    export("lqr-ekf", task="stabilize", format="c", out=folder / "filtered.c", robot="omni")
    code = ctypes.CDLL(str(built(folder / "filtered.c", folder / "filtered.so", "-fPIC", "-shared")))
    pointer = np.ctypeslib.ndpointer(np.float32)
    code.ballbot_first_estimate.argtypes = code.ballbot_estimate.argtypes = (pointer,) * 3
    return code


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_a_filter_starts_anew_after_a_reading_that_is_no_number(bad, filtered):
    code = filtered
    state, place, action = np.zeros(11, np.float32), np.array([0.5, -0.2], np.float32), np.full(3, 0.1, np.float32)
    sensors = np.array([0.01, 0.02, 0.0, 0.1, 0.2, 9.8, 0.0, 0.0, 0.0], np.float32)
    code.ballbot_first_estimate(sensors, place, state)
    first = state.copy()
    for i, part in ((0, sensors), (8, sensors), (1, action)):
        code.ballbot_first_estimate(sensors, place, state)
        right, part[i] = part[i], bad
        code.ballbot_estimate(sensors, action, state)
        assert np.isnan(state).all()
        part[i] = right
        code.ballbot_estimate(sensors, action, state)
        np.testing.assert_allclose(state, first, atol=1e-3)  # but the first estimate moved the place
    code.ballbot_first_estimate(sensors, np.full(2, bad, np.float32), state)
    assert np.isnan(state).all()
    code.ballbot_estimate(sensors, action, state)
    assert np.isfinite(state).all()


def test_two_controllers_are_in_one_program_of_c_or_cpp(tmp_path):
    task = make_task("stabilize")
    export_c(LQR, tmp_path / "left.c", task, prefix="left")
    policy = random_policy(task, (8,)).save(tmp_path / "mine", {})
    export_c(policy, tmp_path / "right.c", task, prefix="right")
    text = """
        #define LEFT_HEADER
        #define RIGHT_HEADER
        #include "left.c"
        #include "right.c"
        int main(void) {
            float state[8] = {1}, seen[LEFT_OBSERVATIONS], one[2], other[2];
            left_reset(); right_reset();
            left_observe(state, 0, 0, seen); left_act(seen, one); right_act(seen, other);
            return one[0] == other[0];
        }"""
    for name in ("main.c", "main.cpp"):
        (tmp_path / name).write_text(text)
        language = "c++" if name.endswith("cpp") else "c"
        for part in (name, "left.c", "right.c"):
            subprocess.run(
                [COMPILER, "-x", language, "-c", str(tmp_path / part), "-o", str(tmp_path / f"{part}.o")], check=True
            )
        objects = [str(tmp_path / f"{part}.o") for part in (name, "left.c", "right.c")]
        subprocess.run([COMPILER, *objects, "-o", str(tmp_path / "program"), "-lm"], check=True)
        subprocess.run([tmp_path / "program"], check=True)
    with pytest.raises(ValueError, match="prefix must be small letters"):
        export_c(LQR, tmp_path / "other.c", task, prefix="left leg")
