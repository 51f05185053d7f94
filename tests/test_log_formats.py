"""Logs that other programs wrote: ROS bags and dumps of Kugle."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ballbot_baselines.identification.identify import identify
from ballbot_baselines.identification.logs import Log, LogError
from ballbot_baselines.identification.record import Recorded, record
from ballbot_gym import Randomization, named_robot

ROLLING: Any = named_robot("rolling")
OMNI: Any = named_robot("omni")
DRAWN = Randomization(com_height=(1.1, 1.1), position_noise=0.005, lean_noise=0.003, lean_rate_noise=0.01)


def turned(gamma: np.ndarray, theta: np.ndarray, psi: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4), the real part first, of a body that γ turns about y, then θ about −x, then ψ about z."""

    def product(a: tuple[Any, ...], b: tuple[Any, ...]) -> tuple[Any, ...]:
        w, x, y, z = a
        p, q, r, s = b
        return (
            w * p - x * q - y * r - z * s,
            w * q + x * p + y * s - z * r,
            w * r - x * s + y * p + z * q,
            w * s + x * r - y * q + z * p,
        )

    none = np.zeros_like(gamma)
    first = (np.cos(gamma / 2), none, np.sin(gamma / 2), none)
    second = (np.cos(theta / 2), -np.sin(theta / 2), none, none)
    third = (np.cos(psi / 2), none, none, np.sin(psi / 2))
    return np.stack(product(product(first, second), third), axis=1)


class Bag:
    """A ROS 2 bag that is written."""

    def __init__(self, path: Path):
        from rosbags.rosbag2 import Writer
        from rosbags.typesys import Stores, get_typestore

        self.types = get_typestore(Stores.ROS2_HUMBLE)
        self._writer = Writer(path, version=9)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> "Bag":
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def new(self, kind: str, **values: Any) -> Any:
        """A message or a part of one; what is not given is zero."""
        return self.types.types[kind](**values)

    def header(self, t: float) -> Any:
        stamp = self.new("builtin_interfaces/msg/Time", sec=int(t), nanosec=round((t - int(t)) * 1e9))
        return self.new("std_msgs/msg/Header", stamp=stamp, frame_id="")

    def vector(self, x: float, y: float, z: float = 0.0) -> Any:
        return self.new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def quaternion(self, q: np.ndarray) -> Any:
        w, x, y, z = q.tolist()
        return self.new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def imu(self, t: float, q: np.ndarray, rate: np.ndarray, force: np.ndarray) -> Any:
        none = np.zeros(9)
        return self.new(
            "sensor_msgs/msg/Imu",
            header=self.header(t),
            orientation=self.quaternion(q),
            orientation_covariance=none,
            angular_velocity=self.vector(*rate),
            angular_velocity_covariance=none,
            linear_acceleration=self.vector(*force),
            linear_acceleration_covariance=none,
        )

    def odometry(self, t: float, place: np.ndarray, q: np.ndarray, speed: np.ndarray) -> Any:
        point = self.new("geometry_msgs/msg/Point", x=place[0], y=place[1], z=0.0)
        pose = self.new("geometry_msgs/msg/Pose", position=point, orientation=self.quaternion(q))
        twist = self.new("geometry_msgs/msg/Twist", linear=self.vector(*speed), angular=self.vector(0.0, 0.0))
        return self.new(
            "nav_msgs/msg/Odometry",
            header=self.header(t),
            child_frame_id="",
            pose=self.new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            twist=self.new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )

    def joints(self, t: float, names: list[str], angles: np.ndarray, speeds: np.ndarray) -> Any:
        return self.new(
            "sensor_msgs/msg/JointState",
            header=self.header(t),
            name=names,
            position=angles,
            velocity=speeds,
            effort=np.zeros(0),
        )

    def array(self, values: np.ndarray) -> Any:
        layout = self.new("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        return self.new("std_msgs/msg/Float64MultiArray", layout=layout, data=np.asarray(values, np.float64))

    def number(self, value: float) -> Any:
        return self.new("std_msgs/msg/Float64", data=value)

    def write(self, topic: str, t: float, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self.types)
        raw = self.types.serialize_cdr(message, kind)
        self._writer.write(self._connections[topic], round(t * 1e9), raw)


SENSED = """
[columns]
u1 = { topic = "/effort", field = "data[0]", quantity = "command_1", unit = "N m" }
u2 = { topic = "/effort", field = "data[1]", quantity = "command_2", unit = "N m" }
u3 = { topic = "/third", field = "data", quantity = "command_3", unit = "N m" }
turning = { topic = "/imu", field = "angular_velocity.x", quantity = "gyro_x", unit = "rad/s" }
pull = { topic = "/imu", field = "linear_acceleration.z", quantity = "accel_z", unit = "m/s^2" }
lean = { topic = "/imu", field = "orientation", quantity = "lean_y", unit = "rad" }
heading = { topic = "/imu", field = "orientation", quantity = "heading", unit = "rad" }
w2 = { topic = "/joints", field = "velocity[second]", quantity = "wheel_speed_2", unit = "rad/s" }
a1 = { topic = "/joints", field = "position[first]", quantity = "wheel_angle_1", unit = "rad", sign = -1 }
"""
SECONDS = 6.0
START = 1.7e9  # s: clocks count from 1970


def smooth(t: Any, phase: float) -> Any:
    return 0.3 * np.sin(2 * t + phase)


def write_sensed(path: Path, offset: Callable[[str], float] = lambda topic: 0.0) -> None:
    """A bag whose topics have rates and phases of their own."""
    with Bag(path) as bag:
        for t in np.arange(0, SECONDS, 0.01).tolist():
            lean = np.array([[smooth(t, k)] for k in (1, 2)])
            (q,) = turned(*lean, np.array([4 * t]))  # heading turns more than once
            rate, force = np.array([smooth(t, 3), 0.0, 0.0]), np.array([0.0, 0.0, 9.8 + smooth(t, 4)])
            bag.write("/imu", START + t, bag.imu(START + t + offset("/imu"), q, rate, force))
        for t in np.arange(0.003, SECONDS, 0.02).tolist():
            both = np.array([smooth(t, 5), 0.0])
            bag.write(
                "/joints", START + t, bag.joints(START + t, ["first", "second"], both, np.array([0.0, smooth(t, 6)]))
            )
            bag.write("/joints", START + t, bag.joints(START + t, ["head"], np.zeros(1), np.zeros(1)))
        for i, t in enumerate(np.arange(-0.014, SECONDS, 0.02).tolist()):
            bag.write("/effort", START + t, bag.array(np.array([i % 7, 1.0 + 0.1 * np.sin(i)])))
            bag.write("/third", START + t, bag.number(np.cos(i)))


def test_a_ros_bag_is_read_by_the_topics_and_fields_of_its_description(tmp_path: Path) -> None:
    write_sensed(tmp_path / "drive")
    (tmp_path / "drive.toml").write_text(SENSED)
    log = Log.read(tmp_path / "drive", OMNI).readings
    np.testing.assert_allclose(np.diff(log.t), 0.01, atol=1e-6)
    t = log.t - log.t[0]
    begin = 0.01  # the first message of /imu after all topics have one
    column = dict(zip(log.names, log.y.T, strict=True))
    # a line through sines of this frequency over 20 ms is right to 1e-4
    for name, true in {
        "gyro_x": smooth(t + begin, 3),
        "accel_z": 9.8 + smooth(t + begin, 4),
        "lean_y": smooth(t + begin, 2),
        "wheel_speed_2": smooth(t + begin, 6),
        "wheel_angle_1": -smooth(t + begin, 5),
    }.items():
        read = np.isfinite(column[name])
        np.testing.assert_allclose(column[name][read], true[read], atol=1e-3, err_msg=name)
        assert read.mean() > (0.48 if name.startswith("wheel") else 0.98)
    np.testing.assert_allclose(np.diff(column["heading"]), 0.04, atol=1e-6)


def test_a_command_of_a_bag_acts_as_long_as_it_holds(tmp_path: Path) -> None:
    write_sensed(tmp_path / "drive")
    (tmp_path / "drive.toml").write_text(SENSED)
    log = Log.read(tmp_path / "drive", OMNI).readings
    force = np.array([i % 7 for i in range(301)]) / OMNI.wheels.radius
    k = np.arange(2, 280)  # the command that holds from 20 k − 14 to 20 k + 6 ms; rows begin at 10 ms
    shared, whole = log.commands[2 * k - 1, 0], log.commands[2 * k, 0]
    # the clock of the rows is found from stamps of whole nanoseconds
    np.testing.assert_allclose(shared, 0.6 * force[k] + 0.4 * force[k + 1], atol=0.01)
    np.testing.assert_allclose(whole, force[k + 1], atol=0.01)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("/third", "/fourth", r"has no topic '/fourth'; it has '/effort' \(std_msgs/msg/Float64MultiArray\)"),
        ("angular_velocity.x", "angular_velocity.q", "column 'turning': '/imu' has no field 'angular_velocity.q'"),
        ("angular_velocity.x", "angular_velocity", "'angular_velocity' of '/imu' is no number"),
        (
            "velocity[second]",
            "velocity[third]",
            r"column 'w2': no message of '/joints' has a field 'velocity\[third\]'",
        ),
        ('field = "data", ', "", "topic and field must be names, and both are needed"),
        ("[columns]", "rate = 100\n[columns]", "rate is for tables"),
        ("[columns]", 'stamps = "both"\n[columns]', "stamps must be one of 'header', 'received', not 'both'"),
        ('topic = "/third", field = "data", ', "", "give topic and field in every column"),
    ],
)
def test_a_description_that_does_not_fit_a_bag_says_why(old: str, new: str, message: str, tmp_path: Path) -> None:
    write_sensed(tmp_path / "drive")
    (tmp_path / "drive.toml").write_text(SENSED.replace(old, new))
    with pytest.raises(LogError, match=message):
        Log.read(tmp_path / "drive", OMNI)


def test_clocks_that_differ_are_refused_unless_the_time_of_recording_is_asked_for(tmp_path: Path) -> None:
    write_sensed(tmp_path / "drive", offset=lambda topic: -START)  # as from a simulator's clock
    (tmp_path / "drive.toml").write_text(SENSED)
    with pytest.raises(LogError, match=r"the clocks of '/imu' and '.*' are 1.7e\+09 s apart.*stamps = \"received\""):
        Log.read(tmp_path / "drive", OMNI)
    (tmp_path / "drive.toml").write_text('stamps = "received"\n' + SENSED)
    assert len(Log.read(tmp_path / "drive", OMNI).readings.t) > 590


def test_what_is_no_bag_says_so(tmp_path: Path) -> None:
    (tmp_path / "drive.toml").write_text(SENSED)
    for name, content in {"drive.mcap": b"\x89MCAP0\r\nnothing", "drive.db3": b"nothing", "drive.bag": b"no"}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(LogError, match="is not a ROS bag that can be read"):
            Log.read(tmp_path / name, OMNI, tmp_path / "drive.toml")
    with pytest.raises(LogError, match="is not a ROS bag that can be read"):
        Log.read(tmp_path / "drive", OMNI)


DRIVEN = """
[columns]
fx = { topic = "/force", field = "data[0]", quantity = "command_x", unit = "N" }
fy = { topic = "/force", field = "data[1]", quantity = "command_y", unit = "N" }
x = { topic = "/odom", field = "pose.pose.position.x", quantity = "position_x", unit = "m" }
y = { topic = "/odom", field = "pose.pose.position.y", quantity = "position_y", unit = "m" }
gamma = { topic = "/odom", field = "pose.pose.orientation", quantity = "lean_x", unit = "rad" }
theta = { topic = "/odom", field = "pose.pose.orientation", quantity = "lean_y", unit = "rad" }
"""


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    return record(ROLLING, 12.0, randomization=DRAWN, physics="rk4", seed=0)


def test_a_robot_is_identified_from_a_bag(recorded: Recorded, tmp_path: Path) -> None:
    log = recorded.readings
    place, lean = (log.y[:, [log.names.index(f"{name}_{axis}") for axis in "xy"]] for name in ("position", "lean"))
    with Bag(tmp_path / "drive") as bag:
        for t, at, q, u in zip(log.t, place, turned(*lean.T, np.zeros(len(lean))), log.commands, strict=True):
            bag.write("/force", START + t, bag.array(u))
            bag.write("/odom", START + t, bag.odometry(START + t, at, q, np.zeros(2)))
    (tmp_path / "drive.toml").write_text(DRIVEN)
    read = Log.read(tmp_path / "drive", ROLLING)
    result = identify(ROLLING, [read], ("body_mass", "ball_mass"))
    assert result.found.robot.com_height == pytest.approx(recorded.robot.com_height, rel=0.03)


KUGLE = """
format = "kugle"
[columns]
time = { quantity = "time", unit = "s" }
torque_1 = { quantity = "command_1", unit = "N m" }
torque_2 = { quantity = "command_2", unit = "N m" }
torque_3 = { quantity = "command_3", unit = "N m" }
lean_x = { quantity = "lean_x", unit = "rad" }
mti_lean_y = { quantity = "lean_y", unit = "rad" }
position_y = { quantity = "position_y", unit = "m" }
raw_gyroscope_z = { quantity = "gyro_z", unit = "rad/s" }
encoder_angle_2 = { quantity = "wheel_angle_2", unit = "rad" }
"""


def write_kugle(folder: Path, missing: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A dump of Kugle in which the file of the sensors lacks its first rows: main, sensors, γ and θ."""
    t = np.arange(700) / 100
    main, sensor = (np.random.default_rng(width).normal(size=(len(t), width)) for width in (50, 33))
    gamma, theta, psi = smooth(t, 1), smooth(t, 2), 0.5 * t
    main[:, 0] = sensor[:, 0] = 12.5 + t
    main[:, 12:16] = sensor[:, 16:20] = turned(gamma, theta, psi)
    (folder / "sensor").mkdir()
    for path, rows in ((folder / "dump.txt", main), (folder / "sensor" / "dump.txt", sensor[missing:])):
        path.write_text("".join("\t".join(f"{value:.10g}" for value in row) + "\n" for row in rows))
    return main, sensor, gamma, theta


def test_a_dump_of_kugle_is_read_with_its_sensors_and_attitudes(tmp_path: Path) -> None:
    main, sensor, gamma, theta = write_kugle(tmp_path)
    (tmp_path / "dump.toml").write_text(KUGLE)
    log = Log.read(tmp_path / "dump.txt", OMNI).readings
    assert len(log.t) == len(main) - 1  # the first row has no sensors
    column = dict(zip(log.names, log.y.T, strict=True))
    for name, true in {
        "lean_x": gamma,
        "lean_y": theta,
        "position_y": main[:, 11],
        "gyro_z": sensor[:, 6],
        "wheel_angle_2": sensor[:, 11],
    }.items():
        read = np.isfinite(column[name])
        assert read.mean() > 0.98
        np.testing.assert_allclose(column[name][read], true[1:][read], atol=1e-8, err_msg=name)
    close = np.isclose(log.commands, main[1:, 47:] / OMNI.wheels.radius, atol=1e-6)
    assert close.mean() > 0.98


def test_a_dump_whose_last_row_was_cut_off_is_read(tmp_path: Path) -> None:
    write_kugle(tmp_path)
    text = (tmp_path / "dump.txt").read_text()
    (tmp_path / "dump.txt").write_text(text[:-100])
    (tmp_path / "dump.toml").write_text(KUGLE)
    assert len(Log.read(tmp_path / "dump.txt", OMNI).readings.t) == 698


def test_what_is_no_dump_of_kugle_says_so(tmp_path: Path) -> None:
    (tmp_path / "dump.toml").write_text(KUGLE)
    (tmp_path / "dump.txt").write_text("1\t2\t3\n" * 1000)
    with pytest.raises(LogError, match="is no dump of Kugle: its rows have 3 columns and not 50"):
        Log.read(tmp_path / "dump.txt", OMNI)
    (tmp_path / "dump.txt").write_text("time,x\n" * 1000)
    with pytest.raises(LogError, match="is no dump of Kugle"):
        Log.read(tmp_path / "dump.txt", OMNI)
    (tmp_path / "dump.txt").unlink()
    main, *_ = write_kugle(tmp_path)
    rows = np.column_stack([main[:, 0] + 0.005, np.zeros((len(main), 32))])
    (tmp_path / "sensor" / "dump.txt").write_text("\n".join("\t".join(map(str, row)) for row in rows.tolist()))
    with pytest.raises(LogError, match="have other times"):
        Log.read(tmp_path / "dump.txt", OMNI)
