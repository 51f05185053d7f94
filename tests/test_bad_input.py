"""One table of wrong input: every call is refused with a message that names what is wrong, and what to give instead.

Every case is a call, and what its message must contain. A call gets an empty folder. Cases of the command line are what is
typed after `ballbot`.
"""

import io
import itertools
import json
import math
import shlex
import struct
import zipfile
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import safetensors.torch
import torch
from builders import result

from ballbot_baselines import Backoff
from ballbot_gym import BallbotEnv, certified, files
from ballbot_gym.env import make_task
from ballbot_gym.robot import URDF_PATH, Randomization, default_params, read_urdf
from ballbot_gym.tasks import TASKS as TASK_NAMES
from ballbot_gym.trajectory import Trajectory
from ballbot_gym.vector import BallbotVectorEnv
from ballbot_gym.vector.batch import BallbotBatch
from ballbot_train import evaluate, load_policy
from ballbot_train.cli import _run
from ballbot_train.evaluation.controllers import controllers_of
from ballbot_train.evaluation.results import leaderboard, read_results, write_results
from ballbot_train.learning import training
from ballbot_train.learning.datasets import load_demos
from ballbot_train.learning.demonstrations import DemoConfig, write_demos
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.policy.files import PolicySpec
from ballbot_train.policy.network import PolicyNetwork
from ballbot_train.work import jobs

REFUSALS = (ValueError, TypeError, gymnasium.error.Error)
"""What a wrong call may raise."""


def env(**keywords):
    return BallbotEnv(**({"physics": "rk4"} | keywords))


def started(task="stabilize", seed=0, **keywords):
    return env(task=task).reset(seed=seed, **keywords)


def stepped(action):
    made = env()
    made.reset(seed=0)
    return made.step(action)


def constants(task, **named):
    return lambda folder: started(task, options={"constants": named})


def task(name, **fields):
    return lambda folder: make_task(name, **fields)


def params(**fields):
    return lambda folder: replace(default_params(), **fields)


def randomization(**fields):
    return lambda folder: Randomization(**fields)


ENVS = [
    (lambda f: env(task="dance"), "unknown task 'dance'; known: 'stabilize'"),
    (lambda f: env(physics="dart"), "unknown physics 'dart'; known: 'bullet', 'mujoco', 'rk4'"),
    (lambda f: env(render_mode="ascii"), "unknown render_mode 'ascii'; known"),
    (lambda f: env(frameskip=4), "got an unexpected keyword argument 'frameskip'; it has"),
    (lambda f: env(randomization={"lean_noise": 0.1}), "randomization must be a Randomization, for instance"),
    (lambda f: env(physics_dt=0.003), "physics_dt = 0.003 s must be a whole fraction"),
    (lambda f: env(physics_dt=1e-30), "at least 1/10000 of it"),
    (lambda f: env(physics_dt="0.001"), "physics_dt must be a number of seconds, not '0.001'"),
    (lambda f: env(task=make_task("turn"), duration=4.0), "fields ['duration'] cannot be given together with a Task"),
    (lambda f: started(seed=-1), "-1"),
    (lambda f: started(options={"sate": np.zeros(8)}), "unknown reset options ['sate']; known: 'state', 'constants'"),
    (lambda f: started(options={"state": np.zeros(7)}), "state must be 8 finite numbers"),
    (constants("stabilize", colour=1.0), "has no constants ['colour']; it has none"),
    (lambda f: started(options={"state": [1e200] + [0.0] * 7}), "state must be numbers within ±1e+06"),
    (constants("turn", sped=3.0), "has no constants ['sped']; it has ['speed']"),
    (constants("turn", speed=30.0), "speed must be in (0, 12] m/s, not 30"),
    (constants("orbit", radius=0.1), "radius must exceed"),
    (constants("orbit", speed=0.0), "speed must not be 0"),
    (constants("weave", obstacle0_radius=-1.0), "obstacle0_radius must be positive"),
    (constants("weave", obstacle0_x=7.0, obstacle0_y=0.0, goal_x=7.0), "the goal lies in obstacle 0"),
    (constants("weave", obstacle0_x=0.0, obstacle0_y=0.0, obstacle0_radius=0.5), "start state is out of range"),
    (lambda f: env().step([0.0, 0.0]), "step() before reset()"),
    (lambda f: stepped([0.0]), "action must have shape (2,), not (1,)"),
    (lambda f: evaluate(lambda o: [1j, 0.0], episodes=1, physics="rk4"), "action must be real numbers, not [1j, 0.0]"),
]

NO_REAL_NUMBERS = {
    "complex": lambda zeros: [complex(zero) for zero in zeros],
    "complex array": lambda zeros: np.array(zeros, complex),
    "truth array": lambda zeros: np.zeros(len(zeros), bool),
    "words": lambda zeros: ["0" for _ in zeros],
    "dates": lambda zeros: np.array(["2020" for _ in zeros], "M8[Y]"),
    "masked": lambda zeros: np.ma.masked_array(zeros, [True, *zeros[1:]]),
    "ragged": lambda zeros: [[0.0], *zeros[1:]],
    "huge": lambda zeros: [10**400, *zeros[1:]],
    "without digits": lambda zeros: [10**5000, *zeros[1:]],
    "beyond float64": lambda zeros: np.array(["1e400", *zeros[1:]], np.longdouble),
    "infinite": lambda zeros: [math.inf, *zeros[1:]],
}


@pytest.mark.parametrize("given", NO_REAL_NUMBERS.values(), ids=NO_REAL_NUMBERS)
def test_single_and_vector_envs_refuse_the_same_numbers_as_actions_states_and_constants(given):
    single, action = env(task="orbit"), given([0.0, 0.0])
    for envs in (single, BallbotVectorEnv(1, "orbit", engine="torch", compile=False)):
        envs.reset(seed=0)
        with pytest.raises(ValueError, match=r"^actions? must be (real numbers|finite)"):
            envs.step(action if envs is single else action[None] if isinstance(action, np.ndarray) else [action])
        with pytest.raises(ValueError, match=r"^state must be .*finite numbers"):
            envs.reset(options={"state": given([0.0] * 8)})
        with pytest.raises(ValueError, match=r"^constants must be .*finite numbers"):
            envs.reset(options={"constants": action})


@pytest.mark.parametrize("huge", [1e308, 1e39, 2.0])
def test_single_and_vector_envs_clip_the_same_actions(huge):
    single = env()
    single.reset(seed=0, options={"state": np.zeros(8)})
    expected = single.step([huge, -huge])[-1]
    assert expected["clipped"]
    np.testing.assert_array_equal(expected["force"], [350.0, -350.0])
    for dtype in (torch.float32, torch.float64):
        for engine in ("native", "torch"):
            envs = BallbotVectorEnv(1, engine=engine, dtype=dtype, compile=False)
            envs.reset(seed=0, options={"state": np.zeros(8)})
            infos = envs.step([[huge, -huge]])[-1]
            assert infos["clipped"].all()
            np.testing.assert_array_equal(infos["force"][0], expected["force"])


TASKS = [
    (task("stabilize", duration="8"), "Stabilize: duration must be a number, not '8'"),
    (task("stabilize", duration=1e9), "must be 1 to 1,000,000 control steps"),
    (task("stabilize", duration=1.01), "is not a whole number of control steps"),
    (task("stabilize", control_dt=0), "control_dt must be positive and finite, not 0"),
    (task("stabilize", max_tilt=math.pi / 2), "max_tilt must be below 90°"),
    (task("turn", max_speed=200.0), "max_speed 200 must be in order, and at most 12 m/s"),
    (task("orbit", min_radius=5.0), "min_radius 5 exceeds max_radius 3 m"),
]

ROBOTS = [
    (params(body_mass=math.nan), "body_mass must be positive and finite, not nan"),
    (params(inertia="1"), "inertia must be a number, not '1'"),
    (lambda f: read_urdf(f / "none.urdf"), "none.urdf: no such file"),
    (lambda f: read_urdf(f), "is not a regular file; give the path of a URDF"),
    (lambda f: read_urdf("a\0b"), "give the path of a URDF"),
]


def urdf(old, new, count=1):
    """The paper's URDF with something replaced."""

    def read(folder):
        text = URDF_PATH.read_text()
        assert old in text
        path = folder / "mine.urdf"
        path.write_text(text.replace(old, new, count))
        return read_urdf(path)

    return read


def written(content, reader, name="file"):
    """A reader of a file with some content."""

    def read(folder):
        path = folder / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return reader(path)

    return read


URDFS = [
    (written('<?xml version="1.0" encoding="klingon"?><robot/>', read_urdf), "not well-formed XML"),
    (written("<robot>" + "<link>" * 100_000 + "</link>" * 100_000 + "</robot>", read_urdf), "missing"),
    (written("<robot/>", read_urdf), "link 'ball' is missing"),
    (urdf('<link name="body">', '<link name="ball">'), "link 'ball' is there 2 times"),
    (urdf('"15"', '"inf"'), "value = 'inf' is not a number"),
    (urdf('"1.2875"', '"1e999"'), "ixx = '1e999' is not a number"),
]

RANDOMIZATIONS = [
    (randomization(body_mass=(1.2, 0.8)), "body_mass must be a finite range (low, high)"),
    (randomization(body_mass=(0.0, 1.0)), "body_mass must be positive factors"),
    (randomization(body_mass=(1.0, 1e300)), "body_mass must be at most 1000"),
    (randomization(lean_noise=-0.1), "lean_noise must be finite and at least 0"),
    (randomization(push_interval=0.0), "push_interval must be positive"),
    (randomization(actuator_lag=(-0.1, 0.1)), "actuator_lag must be at least 0"),
    (lambda f: env(randomization=Randomization(actuator_delay=(0.0, 0.03))), "must be whole control steps of 0.02 s"),
]


def npz(**arrays):
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def npy(header, data=b""):
    """An .npy file with any header."""
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def archive(members, method=zipfile.ZIP_DEFLATED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return buffer.getvalue()


def bomb():
    """2.5 GB of zeros in 2.5 MB, and its neighbour: a small file that only says so."""
    content = archive({"t.npy": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (4,), }", bytes(10))})
    sized = bytearray(content)
    at = sized.rindex(b"PK\x01\x02")
    sized[at + 24 : at + 28] = struct.pack("<I", 2_500_000_000)
    return bytes(sized)


def encrypted():
    content = bytearray(npz(t=np.arange(3.0)))
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.rindex(mark) + offset] |= 1
    return bytes(content)


def odd_method(method):
    content = bytearray(npz(t=np.arange(3.0)))
    for mark, offset in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        content[content.rindex(mark) + offset] = method
    return bytes(content)


HUGE = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000, 1000000), }"
STILL = {"t": np.arange(3.0), "x": np.zeros((3, 8)), "u": np.zeros((2, 2))}


def trajectory(**changes):
    return written(npz(**(STILL | changes)), Trajectory.load)


TRAJECTORIES = [
    (lambda f: Trajectory.load(f / "none.npz"), "none.npz: no such file"),
    (lambda f: Trajectory.load(f), "is not a regular file"),
    (lambda f: Trajectory.load("/dev/zero"), "is not a regular file"),
    (written(b"", Trajectory.load), "is not a valid .npz file"),
    (written(b"garbage" * 99, Trajectory.load), "is not a valid .npz file"),
    (written(npz(t=np.arange(3.0)), Trajectory.load), "it has no array x, u"),
    (written(archive({"t.npy": npy(HUGE)}), Trajectory.load), "not a trajectory file"),
    (written(archive({"t.npy": npy(HUGE.replace("<f8", "|O"))}), Trajectory.load), "Object arrays cannot be loaded"),
    (written(bomb(), Trajectory.load), "unpacks to 2384 MiB; at most 256 MiB are read"),
    (written(encrypted(), Trajectory.load), "t.npy is encrypted; write it without a password"),
    (written(odd_method(12), Trajectory.load), "t.npy is compressed by method 12; use numpy.savez"),
    (trajectory(x=np.zeros((3, 8)) * 1j), "x must be real numbers"),
    (lambda f: Trajectory([0, 1], "rest", np.zeros((1, 2))), "x must be real numbers"),
    (lambda f: Trajectory([0, 1e9], np.zeros((2, 8)), np.zeros((1, 2))).resampled(0.02), "more than 1,000,000 times"),
]


def evaluation_set(**changes):
    """Reads Turn's set with some arrays replaced."""

    def read(folder):
        arrays = files.read_npz(certified.path_of(make_task("turn"))) | changes
        path = files.write(
            folder / "set.npz", files.npz({name: part for name, part in arrays.items() if part is not None})
        )
        return certified.load("turn", "paper", path)

    return read


SETS = [
    (
        lambda f: certified.load("turn", "paper", f / "none.npz"),
        'compute all of it with "ballbot certify --tasks turn"',
    ),
    (lambda f: certified.load(make_task("turn", duration=4.0), "paper"), "was computed for Turn("),
    (written(bomb(), lambda path: certified.load("turn", "paper", path)), "unpacks to 2384 MiB"),
    (evaluation_set(costs=None), "it has no array costs"),
    (evaluation_set(states=np.zeros((200, 7))), "states has the shape (200, 7)"),
    (evaluation_set(lengths=np.array([10**9])), "lengths must be 0 to 400 control steps"),
]


def policy(weights=None, raw=None, text=None, **changes):
    """Loads a small policy for Stabilize whose files were changed."""

    def read(folder):
        torch.manual_seed(0)
        network = PolicyNetwork(PolicySpec.of(make_task("stabilize"), hidden=(4,)))
        path = network.save(folder / "mine", {})
        content = json.loads(path.read_text())
        content["spec"] |= changes
        content["spec"] = {key: value for key, value in content["spec"].items() if value is not MISSING}
        path.write_text(json.dumps(content) if text is None else text)
        if weights is not None:
            values = network.state_dict()
            (folder / "mine.safetensors").write_bytes(safetensors.torch.save(values | weights(values)))
        if raw is not None:
            (folder / "mine.safetensors").write_bytes(raw)
        return load_policy(path, "stabilize")

    return read


MISSING = object()


def header(document, data=b""):
    """A safetensors file with any header."""
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    return struct.pack("<Q", len(text)) + text + data


POLICIES = [
    (lambda f: load_policy(f / "none.json"), "none.json is not a policy"),
    (policy(text="{"), "is not valid JSON"),
    (policy(text="[" * 100_000), "it is nested too deeply"),
    (policy(text='{"spec": 3}'), "its spec is not an object"),
    (policy(squash="sigmoid"), "squash must be one of tanh, clip, tanh_in_frame, not 'sigmoid'"),
    (policy(activation="exec"), "activation must be one of tanh, relu, silu, not 'exec'"),
    (policy(linear="false"), "linear must be true or false, not 'false'"),
    (policy(odd=True, activation="relu"), "odd needs the activation tanh"),
    (policy(hidden=[10**12]), "hidden must be whole numbers from 0 to 1000000"),
    (policy(hidden=[10**6] * 9), "the weights do not fit their description"),
    (policy(observations=9), "takes 9 observations"),
    (policy(observation_version=0), "reads observation version 0"),
    (policy(raw=b"\x80\x04pickled"), "mine.safetensors is not a policy"),
    (policy(raw=header({"w": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 4]}}, bytes(4))), "not a policy"),
    (policy(weights=lambda w: {"mlp.0.weight": w["mlp.0.weight"] * math.nan}), "mlp.0.weight holds NaN or infinity"),
    (policy(weights=lambda w: {"mlp.0.bias": torch.full((4,), 3e38)}), "mlp.0.bias holds numbers beyond ±1e+06"),
]


def results(edit=lambda text: text):
    """Reads a benchmark's leaderboard.json after an edit of its text."""

    def read(folder):
        made = [result(episode=i) for i in range(10)]
        write_results(leaderboard(made), made, {"commit": "a"}, folder)
        path = folder / "leaderboard.json"
        path.write_text(edit(path.read_text()))
        return read_results(path)

    return read


def entry(**changes):
    """Reads a leaderboard.json whose first episode has other values."""

    def edit(text):
        document = json.loads(text)
        document["episodes"][0] |= changes
        return json.dumps(document)

    return results(edit)


RESULTS = [
    (lambda f: read_results(f), "leaderboard.json: no such file"),
    (lambda f: read_results(f / "none.json"), "holds no episodes of a benchmark"),
    (results(lambda text: text[:-9]), "is not valid JSON"),
    (results(lambda text: "[" * 100_000), "nested too deeply"),
    (results(lambda text: '{"about": {}}'), "holds no episodes of a benchmark"),
    (entry(cost=None), "has the cost nan"),
    (entry(optimum=0), "the optimum 0"),
]


def dataset(metadata=None):
    """Reads a folder with some metadata as a dataset for Stabilize."""

    def read(folder):
        if metadata is not None:
            (folder / "data").mkdir()
            (folder / "data" / "metadata.json").write_text(metadata)
            (folder / "data" / "main_data.hdf5").write_bytes(b"\x89HDF\r\n\x1a\n" + b"garbage" * 99)
        return load_demos(folder, make_task("stabilize"))

    return read


DESCRIBED = {"demos": {}, "task": repr(make_task("stabilize")), "observation_version": 1}

DEMOS = [
    (dataset(), 'is not a dataset of "ballbot demos"'),
    (dataset("[" * 100_000), "nested too deeply"),
    (dataset('{"demos": 3}'), "not made by ballbot demos"),
    (dataset(json.dumps(DESCRIBED)), 'is damaged; record it again with "ballbot demos"'),
    (lambda f: DemoConfig(episodes=0), "episodes must be 1 to 1000000, not 0"),
    (lambda f: DemoConfig(noise=math.nan), "noise must be finite and at least 0"),
    (lambda f: DemoConfig(expert="me"), "unknown expert me; known: lqr"),
    (lambda f: write_demos(DemoConfig(), f / "name", 1), "is named NAME-vNUMBER"),
    (lambda f: write_demos(DemoConfig(), f / "mine-v0", 0), "workers must be at least 1"),
    (lambda f: Backoff(margin=-0.1), "Backoff: margin must be at least 0"),
]


def settings(learner, **changes):
    return lambda folder: replace(LEARNERS[learner].settings("stabilize"), **changes).check()


def batch(**given):
    """Resets a batch of three with what the functions make of a state (8, 3) and constants (1, 3) of zeros."""
    zeros = {"x": torch.zeros(8, 3), "c": torch.zeros(1, 3)}

    def reset(folder):
        made = BallbotBatch("turn", 3, compile=False)
        made.reset(0)
        made.reset(**{name: value(zeros.get(name)) for name, value in given.items()})

    return reset


def batched(actions):
    """Steps a batch of three."""

    def step(folder):
        made = BallbotBatch("turn", 3, compile=False)
        made.reset(0)
        made.step(actions)

    return step


def vector(seed=0, num_envs=3, **options):
    return lambda folder: BallbotVectorEnv(num_envs, "turn", compile=False).reset(seed=seed, options=options)


FINITE = "must be finite numbers within ±1e+06"

BATCHES = [
    (batch(x=lambda x: x * math.nan), f"x {FINITE}"),
    (batch(x=lambda x: x + 1.5), "start states of envs [0, 1, 2] violate limits of BallbotTurn-v0"),
    (batch(c=lambda c: c + 23), "speed must be in (0, 12] m/s, not 23"),
    (batch(mask=lambda _: [True] * 3), "mask must be a tensor of 3 bools, not [True, True, True]"),
    (batch(seed=lambda _: "abc"), "seed must be a whole number, or one or None for each env, not 'abc'"),
    (batch(seed=lambda _: [1, 2]), "seed has 2 entries for 3 envs"),
    (batch(seed=lambda _: 2**63), "seeds must be in [0, 2^63)"),
    (batch(seed=lambda _: itertools.count()), "seed has more than 3 entries for 3 envs"),
    (batched([[1.0, 0.0]] * 3), "actions must be a tensor of shape (3, 2), not [[1.0, 0.0]"),
    (batched(torch.zeros(2, 3)), "actions must be a tensor of shape (3, 2), not one of shape (2, 3)"),
    (lambda f: BallbotBatch("turn", 10**9), "num_envs must be at most 1048576, not 1000000000"),
    (lambda f: gymnasium.make_vec("BallbotTurn-v0", num_envs=10**9), "num_envs must be at most 1048576"),
    (lambda f: BallbotVectorEnv(2, "turn").reset(options=[1]), "options must be a dict with 'reset_mask' and 'state'"),
    (lambda f: BallbotVectorEnv(2, compile="yes"), "compile"),
    (lambda f: BallbotVectorEnv(2, physics="bullet"), 'num_envs=2, vectorization_mode="sync", physics='),
    (lambda f: BallbotVectorEnv(2, autoreset_mode="never"), "'never' is not a valid AutoresetMode"),
    (lambda f: BallbotVectorEnv(2, engine="jax"), "unknown engine 'jax'; known: 'auto', 'native', 'torch', 'numpy'"),
    (lambda f: BallbotVectorEnv(2, max_episode_steps=0), "max_episode_steps must be a positive whole number"),
    (vector(num_envs=2, reset_mask=np.ma.masked_array([True, False], [True, False])), "must be a NumPy array of bool"),
    (lambda f: BallbotVectorEnv(2, dtype="float16"), "dtype must be torch.float32 or torch.float64, not float16"),
    (vector(state=[1e200] + [0.0] * 7), "state must be numbers within ±1e+06, not [1e+200"),
    (vector(state=[math.nan] * 8), "state must be finite numbers that broadcast to"),
    (vector(state=np.zeros((2, 8))), "state must be finite numbers that broadcast to"),
    (vector(constants={"speed": 1e200}), "constant 'speed' must be numbers within ±1e+06"),
    (vector(constants=[[3.0]] * 2), "constants must be finite numbers that broadcast to"),
    (vector(reset_mask=[True]), "must be a NumPy array of bool"),
    (vector(reset_mask=np.ones(3, int)), "must be a NumPy array of bool"),
    (vector(reset_mask=np.zeros(3, bool)), "True somewhere"),
    (vector("abc"), "seed must be a whole number"),
    (vector(-1), "seeds must be in [0, 2^63), not -1"),
]

LEARNING = [
    (settings("apg", iterations=-5), "iterations must be 1 to 1000000000, not -5"),
    (settings("apg", num_envs=10**12), "num_envs must be 1 to 1048576"),
    (settings("apg", learning_rate=math.nan), "learning_rate must be finite and positive, not nan"),
    (settings("dagger", gathering_iterations=-1), "gathering_iterations must be 0 to 1000000000, not -1"),
    (settings("ppo", num_steps=10**4, num_envs=10**5), "1000000000 env steps per iteration, and at most 100000000"),
    (settings("ppo", std=0.0), "std must be finite and positive, not 0.0"),
    (settings("ppo", gamma=1.5), "gamma must be 0 to 1, not 1.5"),
    (settings("ppo", imitation_weight=math.inf), "imitation_weight must be finite"),
    (settings("dagger", hidden=(0,)), "hidden must be 1 to"),
]


def nothing(observation):
    return np.zeros(2)


EVALUATION = [
    (lambda f: evaluate(nothing, episodes=0), "episodes must be 1 to 200, not 0"),
    (lambda f: evaluate(nothing, episodes=[0]), "episodes must be a number of episodes, not"),
    (lambda f: training.score_and_validate(None, make_task("turn", control_dt=0.01)), "was computed for Turn("),
    (lambda f: evaluate(None), "None is not a policy: give a Controller"),
    (lambda f: evaluate("pid"), "unknown controller 'pid'"),
    (lambda f: evaluate("mine.zip"), "mine.zip: no such file"),
    (lambda f: controllers_of([]), "give at least one task"),
    (lambda f: controllers_of(["turn"], ["lqr", "lqr"]), "controller lqr is given more than once"),
    (written("{", lambda path: jobs.RunFolder(path.parent, path.name).claim({}), "config.json"), "is damaged"),
]

GROUPS = {
    "env": ENVS,
    "task": TASKS,
    "robot": ROBOTS,
    "urdf": URDFS,
    "randomization": RANDOMIZATIONS,
    "trajectory": TRAJECTORIES,
    "set": SETS,
    "policy": POLICIES,
    "results": RESULTS,
    "demos": DEMOS,
    "batch": BATCHES,
    "learning": LEARNING,
    "evaluation": EVALUATION,
}

CASES = [
    pytest.param(call, message, id=f"{group}-{i}")
    for group, cases in GROUPS.items()
    for i, (call, message) in enumerate(cases)
]


@pytest.mark.parametrize(("call", "message"), CASES)
def test_wrong_input_is_refused_with_a_message_that_names_it(call, message, tmp_path):
    with pytest.raises(REFUSALS) as refused:
        call(tmp_path)
    assert message in str(refused.value)
    assert len(str(refused.value)) < 1500


TYPED = [
    ("benchmark --tasks dance", "unknown task dance; known: stabilize"),
    ("certify --episodes 1 --shards nowhere://set", "nowhere://set/stabilize cannot be read"),
    ("train dagger --demos nowhere://set", "nowhere://set cannot be read"),
    ("demos --pushes 1e9", "pushes must be at most 50 per second, one in every control step"),
    ("paper --only fig9", "unknown problem fig9"),
    (
        "benchmark --tasks orbit --controllers lqr --randomization windy",
        "unknown randomization 'windy'; known: 'unknown'",
    ),
    ("optimize stabilize --duration 1000", "is too long to optimize; give at most 100 s"),
    ("compare a b", "no such file"),
    (
        "replay stabilize --controllers lqr --physics rk4 --format webp --speed 1e-9",
        "frames; give another speed or fps",
    ),
    ("train dance", "unknown learner dance; known: apg, dagger, ppo, sac"),
    ("train apg --demos x", "apg does not support demonstrations; train with dagger or ppo or sac"),
    ("train shac --horizon 0", "`shac` is now `apg`: write `ballbot train apg`, without --horizon 0"),
    ("train sac --history 2", "sac does not support a history (--history); train with apg or dagger or ppo"),
    ("train ppo --task weave --symmetry routes", "invalid choice"),
    ("train dagger --gathering-iterations 0", "gathering_iterations 0 needs demonstrations: give --demos"),
    ("evaluate apg --fresh 0", "the number of fresh episodes must be 1 to 1,000,000, not 0"),
    ("evaluate apg --optima 11", "give --optima with --fresh"),
    ("evaluate apg --fresh 10 --physics bullet", "leave out --physics"),
    ("evaluate apg --episodes 201", "episodes must be 1 to 200, not 201"),
    ("evaluate apg --fresh 10 --optima 11", "optima must be at most the 10 fresh episodes, not 11"),
    ("evaluate apg --fresh 10 --out /dev/null", "/dev/null cannot be a folder, because a file is in its place"),
    ("evaluate lqr --fresh 10", "lqr is an expert"),
    ("evaluate apg-ekf --robot omni_strong --fresh 10", "apg-ekf is behind the filter of sensors"),
    ("train ppo --task stabilize --symmetry frame", "has no frame"),
    ("train ppo --episode-seconds 0.013", "is not a whole number of control steps"),
    ("benchmark --controllers mine.json", "mine.json is not a policy"),
    ("train apg --test-episodes 201", "test_episodes must be 1 to 200, not 201"),
    ("evaluate shac --fresh 10", "unknown controller shac"),  # no policy has this name
    ("replay stabilize turn", "give one task"),
    ("export lqr", "lqr is an expert"),
    ("export apg-ekf --task orbit --robot omni_strong --format c", "leave out -ekf"),
]


@pytest.mark.parametrize(("typed", "message"), TYPED, ids=[typed for typed, _ in TYPED])
def test_what_is_typed_wrong_ends_with_a_message_and_a_status_and_writes_nothing(
    typed, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    try:
        status = _run(shlex.split(typed))
    except SystemExit as end:  # tyro ends so
        status = end.code
    printed = capsys.readouterr()
    said = " ".join((printed.err + printed.out).replace("│", " ").split())
    assert message in said
    assert "Traceback" not in said
    assert status in (1, 2)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("learner", LEARNERS)
def test_the_settings_tuned_for_every_task_make_sense(learner):
    for name in TASK_NAMES:
        LEARNERS[learner].settings(name).check()
