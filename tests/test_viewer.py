"""What the page in the browser is sent, and an environment that shows itself there."""

import time
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest

from ballbot_gym.drawing import FORCE, PUSH, Drawing, GroundPath, Robot, pose
from ballbot_gym.env import BallbotEnv
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.viewer import Viewer, _dragged

pytest.importorskip("viser")

STATE = np.array([0.5, -0.2, 0.3, -0.4, 0, 0, 0, 0])


@pytest.fixture
def viewer():
    viewer = Viewer(port=0)
    yield viewer
    viewer.close()


def nodes(viewer):
    """What viser shows in the scene, by name."""
    return {name: node for name, node in viewer.server.scene._handle_from_node_name.items() if "/world/" in name}


def test_the_page_shows_robots_arrows_paths_and_markers_where_they_are(viewer, params):
    empty = set(nodes(viewer))
    ghost = Robot(STATE + 1, "#c0392b", alpha=0.4, label="LQR fell")
    robot = Robot(STATE, "#e08a00", u=np.array([200.0, 0.0]), push=np.array([0.0, 100.0]))
    path = GroundPath(np.array([[0, 0], [1, 0], [1, 1.0]]), "#e08a00")
    markers = (Marker((1.0, 0.0), 0.3, 0.25, (0.8, 0.1, 0.1, 1.0)), Marker((1, 0), 2, 0, (0, 0, 1, 1), ring=True))
    viewer.draw(Drawing(params, (ghost, robot), (path,), markers))
    shown, place = nodes(viewer), pose(params, STATE)
    assert shown["/world/bodies/robot0/ball"].position == pytest.approx(place.ball)
    assert shown["/world/bodies/robot0/body"].wxyz == pytest.approx(place.turn)
    assert shown["/world/lines"].points[-2:, :, :2] == pytest.approx(np.array([[[0, 0], [1, 0]], [[1, 0], [1, 1]]]))
    assert shown["/world/lines"].colors.shape == shown["/world/lines"].points.shape == (48 + 2, 2, 3)  # with the ring
    ((start, end),) = shown[f"/world/{FORCE}"].points
    assert end - start == pytest.approx([0.5, 0, 0])
    assert shown["/world/bodies/robot1/label"].text == "LQR fell"
    assert (len(shown[f"/world/{PUSH}"].points), "/world/bodies/post0" in shown) == (1, True)
    viewer.draw(Drawing(params, (Robot(STATE),), (GroundPath(np.zeros((121, 2)), "#e08a00"),)))
    assert "/world/bodies/robot1/ball" not in nodes(viewer)
    assert [len(nodes(viewer)[f"/world/{name}"].points) for name in ("lines", FORCE)] == [120, 0]
    viewer.draw(Drawing(params, ()))
    assert set(nodes(viewer)) == empty


def test_many_drawings_leave_no_more_messages_than_a_few(viewer, params):
    def messages_after(count):
        for k in range(count):
            robot = Robot(STATE + 0.001 * k, u=np.array([100.0 * (k % 2), 0.0]))
            paths = (GroundPath(np.zeros((k % 7 + 2, 2)), "#e08a00"),) * (k % 3)
            viewer.draw(Drawing(params, (robot,), paths))
        return len(viewer.server._websock_server._broadcast_buffer.message_from_id)

    assert messages_after(200) <= messages_after(10) + 5


@pytest.mark.parametrize(
    ("end", "expected"),
    [
        ((1.0, 0.0, 0.5), (1.0, 0.0)),  # on the level at which the robot was taken
        ((0.0, 0.0, 0.0), (2.5, 0.0)),  # below it, so that the ray came through the level before
        ((0.0, 0.0, 9.0), (0.0, 0.0)),  # above the horizon
        ((np.nan, 0.0, 0.5), (0.0, 0.0)),
        ((1e9, 0.0, 0.5), (3.0, 0.0)),
    ],
)
def test_dragging_moves_on_the_floor(end, expected):
    start = (0.0, 0.0, 0.5) if expected != (2.5, 0.0) else (-5.0, 0.0, 0.5)
    camera = SimpleNamespace(position=(-5.0, 0.0, 1.0))
    event = SimpleNamespace(start_position=start, end_position=end, client=SimpleNamespace(camera=camera))
    assert _dragged(event) == pytest.approx(expected)


def test_an_environment_shows_itself_in_a_page(capsys):
    env = BallbotEnv("turn", physics="rk4", render_mode="human")
    env.reset(seed=0)
    address = capsys.readouterr().err.split()[-1]
    began = time.perf_counter()
    for _ in range(5):
        env.step([0.0, 0.0])
    assert time.perf_counter() - began > 4 * env.task.control_dt  # real time
    assert b"<html" in urllib.request.urlopen(address, timeout=5).read(1000)
    env.close()
    env.close()
