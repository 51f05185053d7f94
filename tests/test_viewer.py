"""What the page in the browser is sent, and an environment that shows itself there."""

import time
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest

from ballbot_gym.drawing import Drawing, GroundPath, Robot, pose
from ballbot_gym.env import BallbotEnv
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.viewer import PageScene, Viewer, _dragged

pytest.importorskip("viser")

STATE = np.array([0.5, -0.2, 0.3, -0.4, 0, 0, 0, 0])


@pytest.fixture
def viewer():
    viewer = Viewer(port=0)
    yield viewer
    viewer.close()


def names(viewer):
    return {name for name in viewer.server.scene._handle_from_node_name if name.startswith("/world/")}


def test_the_page_shows_robots_arrows_paths_and_markers_where_they_are(viewer, params):
    ghost = Robot(STATE + 1, "#c0392b", alpha=0.4, name="ghost")
    robot = Robot(STATE, "#e08a00", u=np.array([200.0, 0.0]), push=np.array([0.0, 100.0]))
    path = GroundPath(np.array([[0, 0], [1, 0], [1, 1.0]]), "#e08a00")
    marker = Marker((1.0, 0.0), 0.3, 0.25, (0.8, 0.1, 0.1, 1.0))
    viewer.draw(Drawing(params, (ghost, robot), (path,), (marker,)))
    ball, body, *_ = viewer._nodes["robot robot"]
    place = pose(params, STATE)
    assert ball.position == pytest.approx(place.ball)
    assert body.wxyz == pytest.approx(place.turn)
    assert viewer._nodes["path path"][0].points.shape == (2, 2, 3)
    start, end = viewer._nodes["force robot"][0].points[0]
    assert end - start == pytest.approx([0.5, 0, 0])
    assert {"/world/ghost/body/shape", "/world/marker0", "/world/push_robot"} <= names(viewer)


def test_what_is_no_longer_drawn_disappears(viewer, params):
    everything = names(viewer)
    path = GroundPath(np.zeros((300, 2)), "#e08a00", name="trace")
    viewer.draw(Drawing(params, (Robot(STATE, name="ghost"), Robot(STATE)), (path,)))
    assert len(viewer._nodes["path trace"][0].points) == 120
    viewer.draw(Drawing(params, (Robot(STATE),)))
    assert "/world/ghost/ball" not in names(viewer)
    viewer.draw(Drawing(params, ()))
    assert names(viewer) == everything


def test_many_drawings_leave_no_more_messages_than_a_few(viewer, params):
    def messages_after(count):
        for k in range(count):
            u = np.array([100.0 * (k % 2), 0.0])
            viewer.draw(
                Drawing(params, (Robot(STATE + 0.001 * k, u=u),), (GroundPath(np.zeros((k % 7 + 2, 2)), "#e08a00"),))
            )
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
    assert isinstance(env._scene, PageScene)
    address = env._scene.address
    assert address in capsys.readouterr().err
    began = time.perf_counter()
    for _ in range(5):
        env.step([0.0, 0.0])
    assert time.perf_counter() - began > 4 * env.task.control_dt  # real time
    assert b"<html" in urllib.request.urlopen(address, timeout=5).read(1000)
    env.close()
    env.close()
