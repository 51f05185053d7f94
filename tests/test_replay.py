"""Strips and films of episodes."""

import os
import signal
import tempfile

import imageio.v2 as imageio
import numpy as np
import pytest

from ballbot_baselines.feedback import trajopt
from ballbot_gym import certified
from ballbot_gym.engines import default_physics
from ballbot_gym.env import make_task
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.trajectory import Trajectory, TrajectoryError
from ballbot_train import cli
from ballbot_train.commands.replay import replay
from ballbot_train.evaluation.names import file_part
from ballbot_train.report.film import film_frames, write_film
from ballbot_train.report.replay import (
    LEAST_SLIP,
    SKID,
    Replay,
    Take,
    certified_replay,
)

FALLING = 5  # a certified episode of Stabilize in which LQR falls, at 0.40 s


def lean(to, seconds=1.0, steps=50):
    """A body that leans along x while the ball rolls along y."""
    x = np.zeros((steps + 1, 8))
    x[:, 2] = np.linspace(0, to, steps + 1)
    x[:, 1] = np.linspace(0, 2, steps + 1)
    return Trajectory(np.linspace(0, seconds, steps + 1), x, np.full((steps, 2), 100.0))


@pytest.fixture
def two_takes():
    takes = (Take("still", lean(0.0), "#c0392b"), Take("leaning", lean(0.8, seconds=0.6), "#1f6fb2", "note"))
    return Replay("a title", takes, (Marker((1.0, 0.0), 0.3, 0.25, (0.8, 0.1, 0.1, 1.0)),))


def test_a_rolling_robot_slips_on_a_smoother_floor_than_it_expects(interpreted, monkeypatch):
    pytest.importorskip("pybullet")
    found, search = [], trajopt.plan_to_track

    def once(*problem, **options):  # the plan is the same for both floors
        found.append(found[0] if found else search(*problem, **options))
        return found[0]

    monkeypatch.setattr(trajopt, "plan_to_track", once)
    shown = certified_replay("stabilize", ["trajopt"], 1, physics="bullet", robot="rolling", frictions=[0.8, 0.6])
    expected, smoother = shown.takes
    assert len(found) == 2
    assert (expected.label, smoother.label) == ("friction 0.8", "friction 0.6")
    assert expected.slip.max() < LEAST_SLIP < smoother.slip.max()
    assert "slips for" in smoother.note
    assert "slips" not in expected.note
    first = smoother.trajectory.t[np.argmax(smoother.slip > LEAST_SLIP)]
    assert smoother.slip_at(first) > LEAST_SLIP
    assert smoother.slip_at(smoother.trajectory.duration) == 0
    for take, t, skids in ((smoother, 3.0, True), (smoother, 0.0, False), (expected, 3.0, False)):
        assert (SKID in [path.color for path in shown.drawing(take, t).paths]) == skids


def test_a_ball_that_does_not_roll_has_no_floors():
    with pytest.raises(ValueError, match="'paper': the friction of the floor has no effect on a PointBall"):
        certified_replay("stabilize", ["lqr"], 0, physics="rk4", frictions=[0.8])


def test_a_film_moves_and_ends_when_the_longest_take_does(two_takes):
    assert two_takes.duration == 1.0
    first, last = film_frames(two_takes, [0.0, 1.0], width=640)
    assert first.shape == last.shape == (360, 640, 3)
    assert first.dtype == np.uint8
    changed = (first.astype(int) - last).any(axis=2)
    assert changed[:, :320].any()
    assert changed[:, 320:].any()


@pytest.mark.parametrize("ending", ["mp4", "webp"])
def test_a_film_is_read_back_with_its_frames_and_duration(two_takes, tmp_path, ending):
    path = write_film(film_frames(two_takes, np.linspace(0.0, 1.0, 11), 320), tmp_path / f"film.{ending}", fps=10)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    with imageio.get_reader(path) as reader:
        frames = list(reader.iter_data())
        assert len(frames) == 11
        assert frames[0].shape[:2] == (180, 320)
        if ending == "mp4":
            assert reader.get_meta_data()["fps"] == 10


def test_a_film_that_is_interrupted_leaves_nothing(two_takes, tmp_path):
    def interrupted():
        yield next(film_frames(two_takes, [0.0], 320))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_film(interrupted(), tmp_path / "film.mp4")
    assert list(tmp_path.iterdir()) == []


def test_the_same_episode_starts_alike_under_every_controller():
    shown = certified_replay("turn", ["lqr", "trajopt"], 2, physics="rk4")
    start = certified.load(make_task("turn"), "paper").states[2]
    for take in shown.takes:
        np.testing.assert_array_equal(take.trajectory.x[0], start)
    assert [take.label for take in shown.takes] == ["LQR", "trajectory optimization + TVLQR"]
    assert len(shown.markers) == 2  # the gate's posts


def test_files_called_the_same_are_told_apart_by_their_folders(tmp_path):
    paths = [lean(to).save(tmp_path / name / "trajectory.npz") for name, to in (("a", 0.1), ("b", 0.2))]
    assert [take.label for take in Replay.of_files(paths).takes] == ["a/trajectory", "b/trajectory"]
    with pytest.raises(TrajectoryError, match="nowhere"):
        Replay.of_files([tmp_path / "nowhere.npz"])


def test_the_command_draws_a_strip_named_after_the_episode(tmp_path):
    replay(("stabilize",), controllers=("lqr",), episode=1, frames=3, seconds=0.4, physics="rk4", out=tmp_path)
    (picture,) = tmp_path.iterdir()
    engine = "" if default_physics() == "rk4" else "-rk4"  # named where it is not the default
    assert picture.name == f"stabilize-lqr-1{engine}.png"
    assert imageio.imread(picture).std() > 5


def test_the_command_films_a_trajectory_file(tmp_path):
    lean(0.5).save(tmp_path / "mine.npz")
    replay(
        (str(tmp_path / "mine.npz"),), format="webp", seconds=0.2, fps=10, speed=0.5, width=160, out=tmp_path / "out"
    )
    name = file_part(str(tmp_path / "mine.npz"))  # two files of one name in two folders have films of their own
    (film,) = (tmp_path / "out").iterdir()
    assert film.name == f"{name}.webp"
    with imageio.get_reader(film) as reader:
        assert len(list(reader.iter_data())) == 5  # of 0.2 s, in slow motion


@pytest.fixture
def interruptible():
    """Shells have what runs in the background ignore Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_film_that_is_stopped_leaves_no_file(number, tmp_path, monkeypatch, capsys):
    """A command ends so on Ctrl-C, and on SIGTERM, as schedulers and `timeout` send it."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))

    def frames():
        yield np.zeros((32, 32, 3), np.uint8)
        assert list((tmp_path / "temporary").iterdir())
        os.kill(os.getpid(), number)
        yield np.zeros((32, 32, 3), np.uint8)

    monkeypatch.setattr(cli, "_call", lambda *typed: write_film(frames(), tmp_path / "out" / "film.mp4"))
    monkeypatch.setattr("sys.argv", ["ballbot", "replay"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 128 + number
    assert "interrupted" in capsys.readouterr().err
    assert [path for path in tmp_path.rglob("*") if not path.is_dir()] == []
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
