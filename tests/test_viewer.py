"""The server whose page shows drawings: what it sends, who may connect, and that no client harms it."""

import copy
import http.client
import json
import socket
import threading
import time
import urllib.request
from functools import partial

import numpy as np
import pytest
from browser import start_chromium

from ballbot_gym.drawing import Drawing, Drawn, GroundPath
from ballbot_gym.drawing.page import moment
from ballbot_gym.drawing.viewer import Viewer
from ballbot_gym.env import BallbotEnv
from ballbot_gym.robot import named_robot
from ballbot_gym.tasks.marker import Marker

pytest.importorskip("websockets")

from visitor import Visitor, wait_for

STATE = np.array([0.5, -0.2, 0.3, -0.4, 0, 0, 0, 0])


@pytest.fixture
def viewer():
    viewer = Viewer(port=0)
    yield viewer
    viewer.close()


def test_a_moment_says_where_robots_arrows_paths_and_markers_are(params):
    ghost = Drawn(STATE + 1, "#c0392b", alpha=0.4, label="LQR fell")
    robot = Drawn(STATE, "#e08a00", u=np.array([200.0, np.inf]), push=np.array([0.0, 100.0]))
    path = GroundPath(np.array([[0, 0], [1, 0], [1, 1.0]]), "#e08a00")
    shown = moment(Drawing(params, (ghost, robot), (path,), (Marker((1.0, 0.0), 0.3, 0.25, (0.8, 0.1, 0.1, 1.0)),)))
    assert json.loads(json.dumps(shown, allow_nan=False))["markers"][0]["position"] == [1.0, 0.0]
    assert shown["robots"][0]["label"] == "LQR fell"
    assert shown["robots"][1]["x"] == [0.5, -0.2, 0.3, -0.4]
    assert shown["robots"][1]["push"] == [0.0, 100.0]
    assert shown["paths"] == [{"points": [[0, 0], [1, 0], [1, 1]], "color": "#e08a00", "dashed": False}]
    assert shown["look"]["robot"]["wheel_radius"] == 0.0


def test_a_robot_with_wheels_has_them_and_a_heading():
    omni, x = named_robot("omni"), np.zeros(11)
    x[8] = 0.7
    shown = moment(Drawing(omni, (Drawn(x),)))
    assert (shown["robots"][0]["yaw"], shown["look"]["robot"]["wheel_radius"]) == (0.7, omni.wheels.radius)


def test_everybody_sees_the_newest_moment_and_those_who_come_later_too(viewer, params):
    with Visitor(viewer.port) as first:
        wait_for(lambda: viewer.is_watched)
        viewer.draw(Drawing(params, (Drawn(STATE),)))
        with Visitor(viewer.port) as second:
            for visitor in (first, second):
                wait_for(lambda visitor=visitor: "moment" in visitor.seen)
                assert visitor.seen["moment"]["robots"][0]["x"] == [0.5, -0.2, 0.3, -0.4]
            seen = first.moments
            viewer.draw(Drawing(params, (Drawn(STATE),)))  # the same
            viewer.draw(Drawing(params, (Drawn(STATE + 1),)))
            wait_for(lambda: second.seen["moment"]["robots"][0]["x"][0] == 1.5)
            assert first.moments <= seen + 1
    wait_for(lambda: not viewer.is_watched)


def test_a_client_that_reads_nothing_holds_up_nobody(viewer, params):
    long = "x" * 2_000_000
    with Visitor(viewer.port) as other:
        stuck = socket.create_connection(("127.0.0.1", viewer.port))
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        key = "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
        head = f"GET /stream HTTP/1.1\r\nHost: localhost:{viewer.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        stuck.sendall(f"{head}{key}\r\n".encode())
        wait_for(lambda: len(viewer._clients) == 2)
        for k in range(4):  # 8 MB
            viewer.draw(Drawing(params, (Drawn(STATE + k, label=long),)))
            wait_for(lambda k=k: other.seen.get("moment", {"robots": [{"x": [0]}]})["robots"][0]["x"][0] == 0.5 + k)
        began = time.monotonic()
        viewer.close()  # which does not wait for it either
        assert time.monotonic() - began < 5
        stuck.close()


def asked(port, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer, text


def test_pages_of_others_and_names_of_others_are_refused(viewer):
    from websockets.exceptions import InvalidStatus

    for origin in ("http://evil.example", "null", "http://localhost:1"):
        answer, text = asked(viewer.port, Origin=origin)
        assert (answer.status, text) == (403, "another page may not connect")
        with pytest.raises(InvalidStatus, match="403"):
            Visitor(viewer.port, Origin=origin)
    for host in ("evil.example", "localhost.evil.example", "192.168.0.1", "[", ""):
        answer, text = asked(viewer.port, Host=host, Origin=f"http://{host}")
        assert (answer.status, "no other name" in text) == (403, True), host


def test_its_own_page_may_connect_and_no_other_may_frame_it(viewer):
    port = viewer.port
    for host in (f"localhost:{port}", f"127.0.0.1:{port}", "localhost:9000", "[::1]:8080"):  # tunnels have other ports
        answer, text = asked(port, Host=host, Origin=f"http://{host}")
        assert (answer.status, "<html" in text) == (200, True)
        assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'self'"
    with Visitor(port, Origin=f"http://127.0.0.1:{port}"):
        wait_for(lambda: viewer.is_watched)


def test_it_serves_the_page_alone_and_listens_on_this_machine_alone(viewer):
    for path in ("/etc/passwd", "/../pyproject.toml", "//", "/assets/page.js"):
        assert asked(viewer.port, path)[0].status == 404
    assert viewer._socket.getsockname()[0] == "127.0.0.1"


def test_a_port_that_is_none_is_said_and_a_taken_one_is_left_alone(viewer):
    with pytest.raises(ValueError, match="port must be 0 to 65535, not 70000"):
        Viewer(70_000)
    other = Viewer(viewer.port)
    assert other.port > viewer.port
    other.close()


MALFORMED = [
    *(
        "",
        "{",
        "null",
        "[]",
        "[1, 2]",
        '["push"]',
        '{"push": 1}',
        '["push", 1, 2]',
        "[" * 4000,
        '["a", ' + "9" * 4000 + "]",
    ),
    *(b"\xff\xfe", b"", '"' + "\\ud800" * 100 + '"', '["\\u0000", NaN]'),
]


def test_messages_that_are_none_end_nothing_and_too_long_ones_end_their_connection_alone(viewer):
    taken = []
    viewer.on_ask = lambda name, value: taken.append((name, value))
    with Visitor(viewer.port) as visitor, Visitor(viewer.port) as other:
        for message in MALFORMED:
            visitor.send(message)
        visitor.ask("a", 1)
        wait_for(lambda: ("a", 1) in taken)
        assert {name for name, _ in taken} <= {"a", "\0"}
        other.send("x" * 100_000)
        wait_for(lambda: len(viewer._clients) == 1)
        visitor.ask("b", 2)
        wait_for(lambda: ("b", 2) in taken)


def test_of_a_flood_of_messages_few_are_taken_and_other_clients_are_served_meanwhile(viewer):
    taken = []
    viewer.on_ask = lambda name, _: taken.append(name)
    with Visitor(viewer.port) as flooding, Visitor(viewer.port) as other:
        flood = threading.Thread(target=lambda: [flooding.ask("flood", i) for i in range(20_000)])
        began = time.monotonic()
        flood.start()
        other.ask("other")
        wait_for(lambda: "other" in taken, 5)
        flood.join()
        flooded = taken.count("flood")
        assert flooded <= 50 + 25 * (time.monotonic() - began) + 1
        time.sleep(0.2)
        flooding.ask("after")
        wait_for(lambda: "after" in taken, 5)


def test_more_pages_than_it_serves_are_refused_until_one_leaves(viewer):
    from websockets.exceptions import InvalidStatus

    visitors = [Visitor(viewer.port) for _ in range(32)]
    wait_for(lambda: len(viewer._clients) == 32)
    with pytest.raises(InvalidStatus, match="503"):
        Visitor(viewer.port)
    visitors.pop().connection.close()
    wait_for(lambda: len(viewer._clients) == 31)
    visitors.append(Visitor(viewer.port))
    for visitor in visitors:
        visitor.connection.close()


def test_an_environment_shows_itself_in_a_page(capsys):
    env = BallbotEnv("turn", physics="rk4", render_mode="human")
    env.reset(seed=0)
    address = capsys.readouterr().err.split()[-1]
    began = time.perf_counter()
    for _ in range(5):
        env.step([0.0, 0.0])
    assert time.perf_counter() - began > 4 * env.task.control_dt  # real time
    assert b"<html" in urllib.request.urlopen(address, timeout=5).read(1000)
    other = copy.deepcopy(env)  # has a page of its own
    env.close()
    env.close()
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(address, timeout=5)
    other.step([0.0, 0.0])
    assert capsys.readouterr().err.startswith("the robot is shown at http://localhost:")
    other.close()


def test_every_environment_has_a_page_of_its_own_which_a_browser_draws(capsys, tmp_path):
    envs = [
        BallbotEnv(task, robot=robot, physics="rk4", render_mode="human")
        for task, robot in (("turn", "paper"), ("orbit", "omni"))
    ]
    addresses = []
    for env in envs:
        env.reset(seed=0)
        addresses.append(capsys.readouterr().err.split()[-1])
    assert len(set(addresses)) == 2
    browser = start_chromium(tmp_path, "800,600")
    try:
        for env, address in zip(envs, addresses, strict=True):
            browser.get(address)
            shown = "return playground.moment.robots.map(({ x }) => x)"
            wait_for(partial(browser.execute_script, shown))
            x = env.get_state().x
            assert browser.execute_script(shown) == [pytest.approx(x[:4], abs=1e-4)]
            assert browser.execute_script("return playground.find('controls').hidden")  # nothing there to control
            for _ in range(5):
                env.step(np.array([1.0, 0, 0])[: env.params.action_size])
            wait_for(lambda x=x, shown=shown: browser.execute_script(shown)[0] != pytest.approx(x[:4], abs=1e-4))
        assert [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    finally:
        browser.quit()
        for env in envs:
            env.close()
