"""From a log to the robot that made it."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ballbot_baselines import LqrController
from ballbot_baselines.identification.checks import Predictions
from ballbot_baselines.identification.estimate import Found, Problem, _widening
from ballbot_baselines.identification.identify import identify
from ballbot_baselines.identification.likelihood import Innovations, Readings
from ballbot_baselines.identification.logs import Log, LogError
from ballbot_baselines.identification.record import Recorded, Waves, record
from ballbot_baselines.identification.scores import _scores
from ballbot_gym import Randomization, named_robot
from ballbot_gym.env import make_task
from ballbot_gym.robot import Ballbot, read_urdf
from ballbot_train.commands.identify import identify as command

ROBOT: Any = named_robot("rolling")
DRAWN = Randomization(
    com_height=(1.1, 1.1),
    force=(0.9, 0.9),
    actuator_delay=(0.02, 0.02),
    position_noise=0.005,
    lean_noise=0.003,
    velocity_noise=0.03,
    lean_rate_noise=0.01,
    lean_bias=0.003,
)
KNOWN = ("body_mass", "ball_mass")


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    return record(ROBOT, 20.0, randomization=DRAWN, physics="rk4", seed=0)


@pytest.fixture
def readings(recorded: Recorded) -> Readings:
    return recorded.readings


def written(readings: Readings, folder: Path, robot: Ballbot = ROBOT) -> Log:
    """A log that went through its files."""
    return Log.read(Log.write(readings, folder / "log.csv"), robot)


def changed(readings: Readings, name: str, factor: float) -> Readings:
    """A log in which a column is multiplied by a factor."""
    y, commands = readings.y.copy(), readings.commands.copy()
    if name in readings.names:
        y[:, readings.names.index(name)] *= factor
    else:
        commands[:, Readings.commanded(ROBOT).index(name)] *= factor
    return replace(readings, y=y, commands=commands)


def test_a_log_is_the_same_after_it_was_written_and_read(readings: Readings, tmp_path: Path) -> None:
    log = written(readings, tmp_path)
    assert log.readings.names == readings.names
    same = np.isfinite(log.readings.y)
    assert same.mean() > 0.999
    np.testing.assert_allclose(log.readings.y[same], readings.y[same], rtol=1e-8)
    np.testing.assert_allclose(log.readings.t, readings.t, atol=1e-9)


def test_a_log_determines_the_robot_and_its_delay(recorded: Recorded, tmp_path: Path) -> None:
    result = identify(ROBOT, [written(recorded.readings, tmp_path)], KNOWN)
    by_name = {each.parameter.name: each for each in result.found.estimates}
    for name, true in {
        "com_height": recorded.robot.com_height,
        "force_limit": recorded.robot.force_limit,
        "delay": recorded.delay,
    }.items():
        each = by_name[name]
        assert each.determined
        # 1.5 intervals are 2.9 standard deviations
        assert abs(each.value - true) < 1.5 * (each.high - each.low) / 2, name
    assert by_name["com_height"].value == pytest.approx(recorded.robot.com_height, rel=0.02)
    assert by_name["delay"].value == pytest.approx(recorded.delay, abs=0.005)
    assert by_name["lean noise"].value == pytest.approx(DRAWN.lean_noise, rel=0.1)
    nominal, found = result.predictions.errors[:, :, 1]
    assert (found < nominal).all()
    assert result.found.robot.com_height == by_name["com_height"].value


def test_a_log_does_not_separate_masses_from_the_strength_of_the_drive(recorded: Recorded) -> None:
    """All masses, all inertias and the forces times one factor move the robot the same way."""
    problem = Problem(ROBOT, recorded.readings.names)
    _, _, h = problem.information([recorded.readings], np.zeros(len(problem.parameters)))
    scale = np.zeros(len(h))
    for i, each in enumerate(problem.parameters):
        if each.name in ("body_mass", "ball_mass", "inertia", "axial_inertia", "force_limit"):
            scale[i] = 1 / each.spread
    scale /= np.linalg.norm(scale)
    assert scale @ h @ scale < 1e-6 * np.trace(h)


def test_innovations_of_the_true_robot_are_as_large_as_expected(recorded: Recorded) -> None:
    problem = Problem(ROBOT, recorded.readings.names)
    z = np.zeros(len(problem.parameters))
    true = {"position noise": 0.005, "lean noise": 0.003, "speed noise": 0.03, "lean_rate noise": 0.01}
    for i, each in enumerate(problem.parameters):
        if each.name in true:
            z[i] = np.log(true[each.name] / each.nominal) / each.spread
        if each.name.endswith("drift"):
            z[i] = np.log(1e-3 / each.nominal) / each.spread
    z = problem.z_of(recorded.robot, recorded.delay, z)
    found = Innovations.of(ROBOT, recorded.readings, problem.lanes(z[None]))
    squares = (found.missed**2 / found.variance)[200:, 0]  # after the leans' biases, which are not given, were found
    rates = [i for i, name in enumerate(recorded.readings.names) if not name.startswith("lean_")]
    # the mean of 1800 squares of standard normal numbers has a standard deviation of 0.033
    np.testing.assert_allclose(squares[:, rates].mean(axis=0), 1.0, atol=0.15)


def test_the_slope_of_the_likelihood_is_that_of_its_values(readings: Readings) -> None:
    problem = Problem(ROBOT, readings.names, KNOWN)
    part = readings.between(0, 300)
    z, step = np.full(len(problem.parameters), 0.1), 1e-3
    _, slope, _ = problem.information([part], z)
    for i in range(len(z)):
        (up, *_), (down, *_) = (problem.information([part], z + sign * step * np.eye(len(z))[i]) for sign in (1, -1))
        assert slope[i] == pytest.approx((up - down) / (2 * step), rel=0.02, abs=0.5)


@pytest.mark.slow  # it compiles for half a minute
def test_predictions_of_a_slow_log_are_of_the_next_reading_at_least(readings: Readings) -> None:
    t, y, commands = (each[::50] for each in (readings.t, readings.y, readings.commands))
    problem = Problem(ROBOT, readings.names)
    z = np.zeros((1, len(problem.parameters)))
    found = Predictions.of(problem, z, replace(readings, t=t, y=y, commands=commands))
    assert found.horizons[:2] == (0.1, 0.5)  # of a log with a reading every 0.5 s
    np.testing.assert_array_equal(found.errors[..., 0], found.errors[..., 1])
    np.testing.assert_array_equal(found.constant[:, 0], found.constant[:, 1])
    assert (found.constant > 0).all()


@pytest.mark.filterwarnings("error")
def test_a_log_that_is_too_short_for_a_horizon_has_no_error_there(readings: Readings) -> None:
    problem = Problem(ROBOT, readings.names)
    short = Predictions.of(problem, np.zeros((1, len(problem.parameters))), readings.between(0, 170))
    assert np.isfinite(short.errors[..., :2]).all()
    assert np.isfinite(short.constant[:, :2]).all()
    assert np.isnan(short.errors[..., 2]).all()
    none = Predictions.of(problem, np.zeros((1, len(problem.parameters))), readings.between(0, 90))
    assert np.isnan(none.errors).all()


def test_the_applied_force_is_smooth_in_the_delay_and_depends_on_no_later_command(readings: Readings) -> None:
    problem = Problem(ROBOT, readings.names)
    i, z = [each.name for each in problem.parameters].index("delay"), np.zeros((5, len(problem.parameters)))
    delays, step = np.array([0.0, 0.01, 0.02, 0.004, -0.002]), 1e-6
    z[:, i] = delays / problem.parameters[i].spread

    def forces(change: float, log: Readings = readings) -> np.ndarray:
        moved = z.copy()
        moved[:, i] += change / problem.parameters[i].spread
        return problem.lanes(moved).applied(log)

    here, count = forces(0.0), len(readings.t)
    for k in range(3):  # delays of whole steps of 10 ms
        np.testing.assert_allclose(here[k:, k], readings.commands[: count - k], atol=1e-6)
    left, right = here - forces(-step), forces(step) - here
    assert (
        np.abs(left - right).max() < 0.01 * np.abs(left).max()
    )  # a kink would make them differ by as much as they are
    later = readings.commands.copy()
    later[100:] += 50.0
    assert np.array_equal(forces(0.0, replace(readings, commands=later))[:100], here[:100])


def test_intervals_are_wider_where_errors_of_readings_are_correlated(recorded: Recorded) -> None:
    log, rng = recorded.readings, np.random.default_rng(0)
    noise = np.zeros_like(log.y)
    for k in range(1, len(noise)):  # correlated over 0.2 s
        noise[k] = 0.95 * noise[k - 1] + 0.003 * rng.normal(size=noise.shape[1])
    lean, problem = log.names.index("lean_x"), Problem(ROBOT, log.names, KNOWN)
    noise[:, [j for j in range(noise.shape[1]) if j != lean]] = 0.0
    bias = [each.name for each in problem.parameters].index("lean_x bias")
    z = problem.z_of(recorded.robot, recorded.delay, np.zeros(len(problem.parameters)))
    white, correlated = (
        _widening(*problem.blocks([replace(log, y=log.y + share * noise)], z, seconds=2.0)) for share in (0.0, 1.0)
    )
    assert correlated[bias] > 1.5 * white[bias]


def test_the_command_of_a_log_is_a_share_of_the_full_force_also_for_the_robot_that_made_it(
    recorded: Recorded, tmp_path: Path
) -> None:
    path = Log.write(recorded.readings, tmp_path / "log.csv", ROBOT.force_limit)
    nominal, true = (Log.read(path, robot).readings.commands for robot in (ROBOT, recorded.robot))
    assert recorded.strength == pytest.approx(0.9)
    same = np.isclose(nominal, recorded.readings.commands, rtol=1e-6, atol=1e-6)
    assert same.mean() > 0.99  # the others are taken for glitches
    np.testing.assert_allclose(true, 0.9 * nominal, rtol=1e-6, atol=1e-6)


def test_glitches_are_named_and_left_out(readings: Readings, tmp_path: Path) -> None:
    y = readings.y.copy()
    y[500, 2], y[900, 2] = 1.0, -2.0
    log = written(replace(readings, y=y), tmp_path)
    assert any(
        "column 'lean_x': 2 glitches (0.10%), in SI units 1 at 5.000 s, -2 at 9.000 s" in f for f in log.findings
    )
    assert np.isnan(log.readings.y[[500, 900], 2]).all()


def test_commands_that_are_glitches_are_guessed_and_their_forces_uncertain(readings: Readings, tmp_path: Path) -> None:
    commands = readings.commands.copy()
    commands[800, 0] = 300.0
    log = written(replace(readings, commands=commands), tmp_path).readings
    assert log.guessed is not None
    assert log.guessed[800, 0] == pytest.approx(readings.commands[:, 0].std(), rel=0.1)
    assert log.commands[800, 0] == pytest.approx(readings.commands[799:802, 0].mean(), abs=1.0)
    problem = Problem(ROBOT, log.names)
    lanes = problem.lanes(np.zeros((1, len(problem.parameters))))
    sure, unsure = (Innovations.of(ROBOT, replace(log, guessed=each), lanes).variance for each in (None, log.guessed))
    speed = log.names.index("speed_x")
    assert unsure[802, 0, speed] > sure[802, 0, speed]


def test_the_variance_of_guessed_commands_is_positive_and_as_much_for_every_delay(readings: Readings) -> None:
    guessed = np.zeros_like(readings.commands)
    guessed[200, 0], guessed[300:303, 1] = 20.0, 5.0
    problem = Problem(ROBOT, readings.names)
    index = {each.name: i for i, each in enumerate(problem.parameters)}
    z = np.zeros((6, len(index)))
    for lane, (delay, lag) in enumerate(
        [(0, 0), (1e-4, -0.003), (-1e-4, 0.01), (0.013, -0.003), (0.02, 0), (0.025, 0)]
    ):
        for name, value in (("delay", delay), ("lag", lag)):
            z[lane, index[name]] = value / problem.parameters[index[name]].spread
    variance = problem.lanes(z).uncertain(replace(readings, guessed=guessed))
    assert (variance >= 0).all()
    np.testing.assert_allclose(variance.sum(axis=0), [(guessed**2).sum(axis=0)] * 6, rtol=1e-9)
    np.testing.assert_allclose(variance[201:204, 4, 0], [400 / 6, 800 / 3, 400 / 6])  # about two steps of 10 ms later


def test_the_search_converges_at_a_delay_of_0_where_a_command_was_guessed(recorded: Recorded) -> None:
    """The variance of what was guessed must not be negative at a delay near 0, where the filter would fail."""
    prompt = record(ROBOT, 12.0, randomization=replace(DRAWN, actuator_delay=(0.0, 0.0)), physics="rk4", seed=1)
    guessed = np.zeros_like(prompt.readings.commands)
    guessed[[250, 600, 900], [0, 1, 0]] = 10.0
    problem = Problem(ROBOT, prompt.readings.names, KNOWN)
    found = problem.most_likely([replace(prompt.readings, guessed=guessed)])
    value = {each.parameter.name: each for each in found.estimates}["delay"]
    assert value.determined
    assert abs(value.value) < 0.002


def test_glitches_in_commands_do_not_move_the_delay(recorded: Recorded, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    readings = recorded.readings.between(0, 1000)
    commands = readings.commands.copy()
    hit = rng.random(commands.shape) < 0.01
    commands[hit] += 100 * rng.choice([-1, 1], hit.sum())
    log = written(replace(readings, commands=commands), tmp_path).readings
    problem = Problem(ROBOT, log.names, KNOWN)
    found = {each.parameter.name: each.value for each in problem.most_likely([log]).estimates}
    assert found["delay"] == pytest.approx(recorded.delay, abs=0.003)


def test_stamps_that_jitter_are_named_and_replaced_by_the_clock(readings: Readings, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).normal(0, 0.003, len(readings.t))
    log = written(replace(readings, t=readings.t + noise), tmp_path)
    assert any("jitters: the times between readings have a standard deviation of 4." in each for each in log.findings)
    # a line through 2000 stamps with errors of 3 ms is right to 0.13 ms at its ends
    np.testing.assert_allclose(log.readings.t, readings.t, atol=5e-4)


def test_a_gap_is_named_and_the_filter_starts_again_after_it(readings: Readings, tmp_path: Path) -> None:
    kept = np.r_[0:700, 800 : len(readings.t)]
    cut = replace(readings, t=readings.t[kept], y=readings.y[kept], commands=readings.commands[kept])
    log = written(cut, tmp_path)
    assert log.readings.restarts == (700,)
    assert any("1 gap: 1.010 s at 6.990 s" in each for each in log.findings)


@pytest.mark.parametrize("name", ["position_x", "lean_y", "lean_rate_x", "speed_y", "command_y"])
def test_a_wrong_sign_is_named(readings: Readings, tmp_path: Path, name: str) -> None:
    log = written(changed(readings, name, -1.0), tmp_path)
    with pytest.raises(LogError, match=f"log.csv: column .*'{name}'.* has the wrong sign; correct it"):
        identify(ROBOT, [log])


def test_a_wrong_unit_is_named(readings: Readings, tmp_path: Path) -> None:
    log = written(changed(readings, "lean_x", 180 / np.pi), tmp_path)
    with pytest.raises(LogError, match="column 'lean_x' is in deg, where rad is said"):
        identify(ROBOT, [log])


def test_a_log_of_nonsense_is_refused(readings: Readings, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).normal(size=readings.y.shape)
    log = written(replace(readings, y=noise), tmp_path)
    with pytest.raises(LogError, match="contradict each other and the commands"):
        identify(ROBOT, [log])


def test_logs_with_other_readings_are_refused_together(readings: Readings, tmp_path: Path) -> None:
    log = written(readings, tmp_path)
    fewer = replace(
        log, readings=replace(log.readings, names=log.readings.names[:4], y=log.readings.y[:, :4], delays=())
    )
    with pytest.raises(ValueError, match="has other readings than"):
        identify(ROBOT, [log, fewer])


PLAIN = """
separator = " "
names = ["pwm1", "pwm2", "pwm3", "roll", "pitch", "w1", "w2", "w3"]
rate = 100
[columns]
pwm1 = { quantity = "command_1", unit = "pwm", full = 255 }
pwm2 = { quantity = "command_2", unit = "A", torque_constant = 0.5 }
pwm3 = { quantity = "command_3", unit = "N m" }
roll = { quantity = "lean_y", unit = "deg", sign = -1 }
pitch = { quantity = "lean_x", unit = "deg", delay = 0.01 }
w1 = { quantity = "wheel_speed_1", unit = "rpm" }
w2 = { quantity = "wheel_speed_2", unit = "rad/s", scale = 0.1 }
w3 = { quantity = "wheel_speed_3", unit = "deg/s" }
"""


def test_a_plain_text_log_is_read_by_its_description_alone(tmp_path: Path) -> None:
    omni: Any = named_robot("omni")
    rows = np.random.default_rng(0).integers(-100, 100, (600, 8))
    (tmp_path / "log.txt").write_text("# a robot\n" + "\n".join(" ".join(map(str, row)) for row in rows))
    (tmp_path / "log.toml").write_text(PLAIN)
    log = Log.read(tmp_path / "log.txt", omni).readings
    assert log.names == ("lean_x", "lean_y", "wheel_speed_1", "wheel_speed_2", "wheel_speed_3")
    assert log.delays == (0.01, 0.0, 0.0, 0.0, 0.0)
    factors = np.array([np.pi / 180, -np.pi / 180, 2 * np.pi / 60, 0.1, np.pi / 180])
    read = np.isfinite(log.y)
    np.testing.assert_allclose(log.y[read], (rows[:, [4, 3, 5, 6, 7]] * factors)[read])
    radius = omni.wheels.radius
    commands = rows[:, :3] * np.array([omni.force_limit / 255, 0.5 / radius, 1 / radius])
    assert np.isclose(log.commands, commands).mean() > 0.99
    np.testing.assert_allclose(log.t, np.arange(600) / 100)


GOOD = """
[columns.time]
quantity = "time"
unit = "s"
[columns.a]
quantity = "command_x"
unit = "N"
[columns.b]
quantity = "command_y"
unit = "N"
[columns.c]
quantity = "lean_x"
unit = "rad"
"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("columns = 1", r"has no table \[columns.NAME\]"),
        ("[columns", "is not valid TOML"),
        (f"speed = 3\n{GOOD}", "unknown entry 'speed'"),
        (GOOD.replace("lean_x", "lean"), "column 'c': unknown quantity 'lean'; known: position_x"),
        (GOOD.replace('"rad"', '"grad"'), "unit of lean_x must be one of 'rad', 'deg', 'turn', not 'grad'"),
        (GOOD.replace('"N"', '"V"'), "unit of a command must be one of 'N', 'N m', 'A', 'pwm', not 'V'"),
        (GOOD.replace('"N"', '"pwm"'), "commands in 'pwm' need full"),
        (GOOD + "sign = 2", "sign must be 1 or -1"),
        (GOOD + "sing = 1", "column 'c': unknown entry 'sing'"),
        (GOOD + 'scale = "2"', "scale must be a number, not '2'"),
        (
            GOOD.replace("command_y", "lean_y").replace('unit = "N"\n[columns.c]', 'unit = "rad"\n[columns.c]'),
            "no column has quantity = 'command_y'",
        ),
        (GOOD.replace("command_y", "command_x"), "two columns are 'command_x'"),
        (f"rate = 100\n{GOOD}", "give either a column with quantity = 'time', or rate"),
        (f'separator = "ab"\n{GOOD}', "separator must be one character"),
    ],
)
def test_a_description_that_is_wrong_says_why(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "log.toml").write_text(text)
    with pytest.raises(LogError, match=message):
        Log.read(tmp_path / "log.csv", ROBOT)


ROWS = [f"{k / 100},{np.sin(k)},{np.cos(k)},{0.01 * np.sin(k / 9)}" for k in range(1000)]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["time,a,b,d", *ROWS], "has no column 'c'; it has 'time', 'a', 'b', 'd'"),
        (["time,a,b,c"], "holds no readings"),
        (["time,a,b,c", *ROWS[:100]], "holds 0.99 s; give a log of at least 5 s"),
        (["time,a,b,c", *ROWS[::-1]], "column of time does not grow"),
        (["time,a,b,c", *(f"{row.rpartition(',')[0]},0.5" for row in ROWS)], "column 'c' is always 0.5"),
        (["time,a,b,c", *(f"{row.rpartition(',')[0]},x" for row in ROWS)], "column 'c' holds no numbers, but 'x'"),
        (
            ["time,a,b,c", *(row.replace(",", ";") for row in ROWS)],
            "rows have 1 values for 4 names; is the separator ','",
        ),
    ],
)
def test_a_file_that_is_no_log_says_why(lines: list[str], message: str, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("\n".join(lines))
    (tmp_path / "log.toml").write_text(GOOD)
    with pytest.raises(LogError, match=message):
        Log.read(tmp_path / "log.csv", ROBOT)


def test_rows_that_are_no_numbers_or_go_back_in_time_are_named(tmp_path: Path) -> None:
    rows = ROWS.copy()
    rows[50] = rows[50].rpartition(",")[0] + ",err"
    rows[200] = "0.1" + rows[200].removeprefix("2.0")
    (tmp_path / "log.csv").write_text("\n".join(["time,a,b,c", *rows]))
    (tmp_path / "log.toml").write_text(GOOD)
    log = Log.read(tmp_path / "log.csv", ROBOT)
    assert any("column 'c': 1 cell without a number, the first 'err' in row 51" in each for each in log.findings)
    assert any("the clock goes back in 1 row, the first row 201 at 0.100 s" in each for each in log.findings)
    assert len(log.readings.t) == 999


def test_quantities_are_those_that_the_robot_has() -> None:
    assert "heading" not in Readings.readable(ROBOT)
    assert {"heading", "gyro_z", "wheel_angle_3"} <= set(Readings.readable(named_robot("omni")))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="unknown parameter 'mass'; known: 'body_mass', 'ball_mass'"):
        Problem(ROBOT, ("lean_x",), ("mass",))


def test_numbers_that_are_0_in_the_nominal_robot_stay_0() -> None:
    omni: Any = named_robot("omni")
    robot = replace(omni, wheels=replace(omni.wheels, damping=0.0))
    problem = Problem(robot, ("gyro_x",))
    assert "wheels.damping" not in [each.name for each in problem.parameters]
    nominal = problem.values(np.zeros((1, len(problem.parameters))))
    assert problem.robot_of({name: float(value[0]) for name, value in nominal.items()}) == robot


def test_the_command_writes_a_robot_that_other_commands_take(readings: Readings, tmp_path: Path) -> None:
    written(readings.between(0, 800), tmp_path)
    command((tmp_path / "log.csv",), robot="rolling", known=KNOWN, out=tmp_path / "mine")
    assert {path.name for path in (tmp_path / "mine").iterdir()} == {
        "numbers.csv",
        "numbers.json",
        "residuals.png",
        "robot.urdf",
    }
    record = json.loads((tmp_path / "mine" / "numbers.json").read_text())
    assert record["predictions"]["no_change"][0][2] is None  # the last quarter of 8 s is too short for 1 s
    heights = {each["name"]: each["value"] for each in record["numbers"]}
    assert read_urdf(tmp_path / "mine" / "robot.urdf").com_height == heights["com_height"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "give the path of a log"),
        ({"logs": (Path("log.csv"),), "record": True}, "give one of: paths of logs, --record, --design"),
        ({"record": True, "design": True}, "give one of: paths of logs, --record, --design"),
        ({"design": True, "max_lean": 60.0}, "max_lean must be from 1 to 30 degrees, not 60"),
        ({"record": True, "motion": Path("none.json")}, "none.json: no such file"),
        ({"logs": (Path("none.csv"),)}, "none.toml: no such file"),
        ({"record": True, "seconds": 1.0}, "seconds must be from 5 to 600, not 1"),
        ({"record": True, "seconds": 0.0}, "seconds must be from 5 to 600, not 0"),
        ({"record": True, "seed": -1}, "seed must be at least 0"),
    ],
)
def test_the_command_says_what_is_wrong(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        command(**{"robot": "rolling", "out": tmp_path} | options)


def test_a_designed_motion_is_more_informative_than_balancing_within_its_limit_of_lean(tmp_path: Path) -> None:
    command(robot="rolling", design=True, seconds=5.0, max_lean=6.0, known=KNOWN, out=tmp_path)
    held = json.loads((tmp_path / "motion.json").read_text())
    motion = Waves(*(np.array(held[name]) for name in Waves._fields))
    moved = record(ROBOT, 5.0, motion, None, "rk4")
    assert moved.lean < 1.05 * np.radians(6.0)
    still_made = record(ROBOT, 5.0, Waves.still(), "noisy", "rk4")
    problem = Problem(ROBOT, moved.readings.names, KNOWN)
    i = [each.name for each in problem.parameters].index("com_height")
    moving, balancing = (
        problem.information([each.readings], np.zeros(len(problem.parameters)))[2][i, i] for each in (moved, still_made)
    )
    assert moving > 16 * balancing  # a quarter of the deviation


def test_the_regret_of_the_controller_is_that_of_parts_of_a_log_that_end_at_rest() -> None:
    def motion(t: float) -> np.ndarray:
        return np.array([0.6, 0.0, 0.0]) * (t >= 2.0)

    made = record(ROBOT, 9.0, motion, None, "rk4")
    problem = Problem(ROBOT, made.readings.names, KNOWN)
    z = np.zeros(len(problem.parameters))
    found = Found(problem, z, np.eye(len(z)), 0)
    (score,) = _scores(found, made.readings)
    assert 1.9 < score.begin < 2.1  # when the robot begins to move
    assert score.begin + score.duration == pytest.approx(9.0, abs=0.05)  # it stays at rest until the log ends
    assert abs(score.regret) < 0.005  # LQR is the optimum of small motions; the filter's states are not exact
    driven = record(ROBOT, 6.0, None, None, "rk4")
    assert _scores(found, driven.readings) == []


def test_the_regret_of_a_drive_does_not_depend_on_the_heading_that_the_robot_keeps(interpreted: None) -> None:
    def motion(t: float) -> np.ndarray:
        return np.array([0.4 * (t >= 0.5), 0.0, 0.4])

    omni: Any = named_robot("omni")
    made = record(omni, 4.5, motion, None, "rk4")
    assert made.trajectory.x[-1, 8] == pytest.approx(0.4, abs=0.01)
    problem = Problem(omni, made.readings.names, KNOWN)
    z = np.zeros(len(problem.parameters))
    (score,) = _scores(Found(problem, z, np.eye(len(z)), 0), made.readings)
    assert abs(score.regret) < 0.1  # with the price of the heading it is over 3


def test_a_controller_of_ones_own_drives_the_robot_that_the_seed_draws_from_where_it_is_put() -> None:
    varied, start = Randomization(body_mass=(0.8, 1.2), position_noise=0.005), np.zeros(8)
    start[0] = 0.5
    lqr = LqrController(make_task("stabilize", ROBOT, control_dt=0.01), ROBOT)
    made = record(ROBOT, 5.0, None, varied, "rk4", 3, lqr, start)
    assert made.robot == record(ROBOT, 5.0, Waves.still(), varied, "rk4", 3).robot != ROBOT
    np.testing.assert_array_equal(made.trajectory.x[0], start)
    assert np.abs(made.trajectory.x[-1]).max() < 0.02
    # the log has what the controller saw: the true states with noise
    error = made.readings.y[:, 0] - made.trajectory.x[:-1, 0]
    assert 0.003 < error.std() < 0.007
    with pytest.raises(ValueError, match="a motion or a controller"):
        record(ROBOT, 5.0, Waves.still(), varied, "rk4", 3, lqr)
