from pathlib import Path

import numpy as np
import pytest

from ballbot_gym import files
from ballbot_gym.trajectory import Trajectory, TrajectoryError


def example(n=5, linear=False, slopes=False, seed=0):
    """A trajectory of random numbers at uneven times."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.01, 0.5, n + 1))
    x, xdot = rng.normal(size=(2, n + 1, 8))
    return Trajectory(t, x, rng.normal(size=(n + linear, 2)), xdot if slopes else None)


def cubic_trajectory():
    """States that are cubics of time, with their slopes; returns the trajectory and the exact function."""
    coefficients = np.random.default_rng(1).normal(size=(4, 8))
    t = np.array([0.0, 0.3, 0.5, 1.1])

    def exact(time):
        return coefficients.T @ [1, time, time**2, time**3]

    slope = np.array([coefficients[1:].T @ [1, 2 * s, 3 * s**2] for s in t])
    return Trajectory(t, np.array([exact(s) for s in t]), np.zeros((3, 2)), slope), exact


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("slopes", [False, True])
def test_saved_trajectory_reads_back_bit_by_bit(tmp_path, linear, slopes):
    saved = example(linear=linear, slopes=slopes)
    loaded = Trajectory.load(saved.save(tmp_path / "new" / "folder" / "plan.npz"))
    for name in ("t", "x", "u"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(saved, name))
    assert loaded.held == (not linear)
    if slopes:
        np.testing.assert_array_equal(loaded.xdot, saved.xdot)
    else:
        assert loaded.xdot is None


def test_same_trajectory_is_the_same_file(tmp_path):
    first, second = (example().save(tmp_path / name).read_bytes() for name in ("a.npz", "b.npz"))
    assert first == second


def test_states_with_slopes_are_interpolated_by_cubics_exactly():
    trajectory, exact = cubic_trajectory()
    for t in np.linspace(0, 1.1, 50):
        np.testing.assert_allclose(trajectory.state(t), exact(t), atol=1e-13)


def test_states_without_slopes_and_linear_forces_run_straight(rng):
    trajectory = example(linear=True)
    for t in (*trajectory.t, *rng.uniform(trajectory.t[0], trajectory.t[-1], 50)):
        for got, values in ((trajectory.state(t), trajectory.x), (trajectory.force(t), trajectory.u)):
            expected = [np.interp(t, trajectory.t, column) for column in values.T]
            np.testing.assert_allclose(got, expected, atol=1e-12)


def test_held_forces_change_at_the_knots():
    trajectory = example(n=3)
    for k in range(3):
        np.testing.assert_array_equal(trajectory.force(trajectory.t[k]), trajectory.u[k])
        np.testing.assert_array_equal(trajectory.force(trajectory.t[k + 1] - 1e-9), trajectory.u[k])


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("slopes", [False, True])
def test_before_and_after_the_ends_hold(linear, slopes):
    trajectory = example(linear=linear, slopes=slopes)
    for t, end in ((trajectory.t[0] - 1, 0), (trajectory.t[0], 0), (trajectory.t[-1], -1), (trajectory.t[-1] + 1, -1)):
        np.testing.assert_array_equal(trajectory.state(t), trajectory.x[end])
        np.testing.assert_array_equal(trajectory.force(t), trajectory.u[end])


GOOD = {"t": [0.0, 1.0], "x": np.zeros((2, 8)), "u": np.zeros((1, 2))}

BAD_ARRAYS = {
    "too few states": ({"x": np.zeros((1, 8))}, r"x \(1, 8\) must be"),
    "no components": ({"x": np.zeros((2, 0))}, r"\(2, 0\)"),
    "flat states": ({"x": np.zeros(8)}, r"\(8,\)"),
    "matrix of times": ({"t": np.zeros((2, 1))}, r"t \(2, 1\)"),
    "scalar time": ({"t": 0.0}, "t"),
    "no times": ({"t": [], "x": np.zeros((0, 8)), "u": np.zeros((0, 2))}, "t"),
    "too many forces": (
        {"u": np.zeros((3, 2))},
        r"u \(3, 2\) must be \(1, m\) for held forces, or \(2, m\) for linear ones",
    ),
    "slopes of another shape": ({"xdot": np.zeros((1, 8))}, r"xdot \(1, 8\)"),
    "infinite": ({"x": np.full((2, 8), np.inf)}, "finite"),
    "NaN force": ({"u": [[np.nan, 0.0]]}, "finite"),
    "NaN time": ({"t": [0.0, np.nan]}, "finite"),
    "times that stand still": ({"t": [1.0, 1.0]}, "times must increase"),
    "times that run back": ({"t": [1.0, 0.0]}, "times must increase"),
}


@pytest.mark.parametrize(("change", "problem"), BAD_ARRAYS.values(), ids=BAD_ARRAYS.keys())
def test_arrays_that_are_no_trajectory_are_refused(change, problem):
    with pytest.raises(TrajectoryError, match=problem):
        Trajectory(**{**GOOD, **change})


@pytest.mark.parametrize("name", ["pathlib.Path.replace", "builtins.open"])
def test_write_that_fails_leaves_the_old_file_and_no_other(tmp_path, monkeypatch, name):
    path = files.write(tmp_path / "kept.txt", "old")

    def fail(*args):
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(name, fail)
        with pytest.raises(OSError, match="disk full"):
            files.write(path, "new")
    assert [p.name for p in tmp_path.iterdir()] == ["kept.txt"]
    assert path.read_text() == "old"


def test_file_is_whole_when_its_name_appears(tmp_path, monkeypatch):
    seen = []
    replace = Path.replace

    def look(self, target):
        seen.append((self.read_bytes(), Path(target).exists()))
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", look)
    files.write(tmp_path / "new.bin", b"whole")
    assert seen == [(b"whole", False)]
