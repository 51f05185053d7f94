"""The page of the live playground: its controls, and who may open it."""

import http.client
import re
import signal
import subprocess
import sys
import threading
import time

import pytest

from ballbot_gym.viewer import Viewer
from ballbot_train.play import views
from ballbot_train.play.live_page import PlayPage
from ballbot_train.play.simulation import Playground
from ballbot_train.policy_files import SHIPPED

viser = pytest.importorskip("viser")

from visitor import Visitor, wait_for  # noqa: E402 it needs what comes with viser

STANDING = 3  # a certified episode of Stabilize in which LQR comes to rest


class Opened:
    """A page with a loop that runs in a thread of its own."""

    def __init__(self, port: int = 0, **keywords):
        self.playground = Playground(**{"controller": "lqr", "physics": "rk4", "episode": STANDING} | keywords)
        self.viewer = Viewer(port=port)
        self.page = PlayPage(self.playground, self.viewer)
        self.thread = threading.Thread(target=self.page.run, daemon=True)
        self.thread.start()

    def close(self):
        self.page.stop()
        self.thread.join(10)
        assert not self.thread.is_alive()
        self.viewer.close()
        self.playground.close()

    def do(self, action):
        """Does something between two steps of the loop, and waits for it."""
        done = threading.Event()
        self.page.request(lambda: (action(), done.set()))
        assert done.wait(10)

    def goes_on(self):
        """Waits for another tenth of a second of the simulation."""
        before = self.playground.steps
        wait_for(lambda: self.playground.steps > before + 5)


@pytest.fixture
def opened():
    page = Opened()
    yield page
    page.close()


@pytest.fixture
def visitor(opened):
    with Visitor(opened.viewer.port) as visitor:
        yield visitor


@pytest.fixture
def quiet(capfd):
    """Checks at the end that nothing was written to the terminal, such as a traceback."""
    yield
    time.sleep(0.1)
    said = capfd.readouterr()
    assert "Traceback" not in said.out + said.err
    assert "never retrieved" not in said.err


def test_controls_change_the_playground(opened, visitor):
    visitor.change("Masses, %", 50.0)
    visitor.change("Speed", 2.0)
    visitor.change("Controller", "SHAC")
    visitor.change("Certified episode", 7)
    playground = opened.playground
    wait_for(lambda: playground.episode == 7)
    assert playground.plant["mass"] == 50.0
    assert opened.page.clock.speed == 2.0
    assert playground.main.wanted == "shac"
    visitor.change("All as the controllers believe")
    wait_for(lambda: playground.plant["mass"] == 0.0 == visitor.value("Masses, %"))
    visitor.change("Start", "Random")
    wait_for(lambda: playground.episode is None)


def test_a_policy_file_becomes_a_controller_that_can_be_chosen(opened, visitor):
    path = str(SHIPPED / "stabilize-shac.json")
    visitor.change("Policy file", path)
    wait_for(lambda: opened.playground.main.name == path, 60)
    wait_for(lambda: visitor.value("Controller") == "stabilize-shac")
    visitor.change("Controller", "LQR")
    wait_for(lambda: visitor.value("Policy file") == "")
    visitor.change("Policy file", "nowhere.json")
    wait_for(lambda: "unknown controller 'nowhere.json'" in opened.playground.notice)


def test_what_a_file_is_called_is_shown_as_it_is(opened, visitor):
    visitor.change("Policy file", "<img src=x onerror=alert(1)>[a](b).json")
    wait_for(lambda: "&#60;img src=x onerror=alert(1)&#62;[a]&#40;b).json" in visitor.text())


def test_a_push_comes_from_the_sliders(opened, visitor):
    opened.goes_on()
    visitor.change("N·s", 20.0)
    visitor.change("Direction, °", 90)
    visitor.change("Push")
    wait_for(lambda: opened.playground.shown_push is not None)
    assert views.drawing(opened.playground).robots[-1].push == pytest.approx([0, 20.0], abs=1e-9)


def test_everybody_who_has_opened_the_page_may_use_it(opened, visitor):
    with Visitor(opened.viewer.port) as other:
        other.change("Speed", 0.5)
        wait_for(lambda: visitor.value("Speed") == 0.5 == opened.page.clock.speed)
    visitor.change("Speed", 1.0)
    wait_for(lambda: opened.page.clock.speed == 1.0)


def test_dragging_pushes(opened, visitor):
    opened.goes_on()
    for phase in ("start", "update", "end"):
        visitor.drag(phase, 0.5)
    wait_for(lambda: opened.playground.shown_push is not None)
    assert opened.playground.shown_push == pytest.approx([65.0, 0.0])  # as far as its arrow reaches


def test_nothing_moves_while_nobody_is_there(opened):
    with Visitor(opened.viewer.port):
        opened.goes_on()
    wait_for(lambda: not opened.page.visitors)
    opened.do(lambda: None)
    left = opened.playground.steps
    time.sleep(0.2)
    assert opened.playground.steps == left
    with Visitor(opened.viewer.port):
        opened.goes_on()


def test_a_pause_holds_everything_and_a_step_moves_once(opened, visitor):
    opened.goes_on()
    visitor.press("pause or play")
    wait_for(lambda: opened.page.paused)
    time.sleep(0.05)
    before = opened.playground.seconds
    time.sleep(0.1)
    assert opened.playground.seconds == before
    visitor.change(" ", "Step")
    wait_for(lambda: opened.playground.seconds > before)
    assert opened.playground.seconds == pytest.approx(before + 0.02)


def test_an_episode_is_handed_to_the_browser_as_a_file(opened, visitor, tmp_path):
    opened.goes_on()
    visitor.change("Save the episode so far")
    wait_for(lambda: "stabilize.npz" in visitor.files)


def works(opened, visitor, k=0):
    """Whether the page does what its driver asks, for the k-th time."""
    speed = (2.0, 0.5)[k % 2]
    visitor.change("Speed", speed)
    wait_for(lambda: opened.page.clock.speed == speed)


def test_what_cannot_be_done_is_said_and_goes_back(quiet, opened, visitor):
    visitor.change("Task", "dance")
    wait_for(lambda: "unknown task dance" in opened.playground.notice)
    wait_for(lambda: visitor.value("Task") == "stabilize")
    visitor.change("Speed", 0.0)
    wait_for(lambda: "Speed must be 0.1 to 2, not 0" in opened.playground.notice)
    opened.goes_on()


def test_who_leaves_while_something_is_saved_or_dragged_harms_nothing(quiet, opened, visitor):
    opened.goes_on()
    with Visitor(opened.viewer.port) as other:
        other.drag("start", 0.5)
        for label in ("Save the episode so far", "Push"):
            other.change(label)
        other.connection.close()
    wait_for(lambda: len(opened.page.visitors) == 1)
    works(opened, visitor)


@pytest.mark.slow
def test_the_server_ends_when_it_is_told_to(tmp_path):
    code = "from ballbot_train.commands.play import play; play('stabilize', 'lqr', (), port=0, physics='rk4')"
    server = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        port = int(re.search(r":(\d+)", server.stdout.readline()).group(1))
        with Visitor(port) as visitor:
            wait_for(lambda: "LQR, " in visitor.text().replace("\\", ""), 60)
        server.send_signal(signal.SIGTERM)
        assert server.wait(20) == 0
    finally:
        server.kill()
        server.wait()


def asked(port, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    text = answer.read()
    connection.close()
    return answer, text


FOREIGN = [
    ({"Origin": "http://evil.example"}, "another page"),
    ({"Origin": "null"}, "another page"),
    ({"Origin": "http://localhost:1"}, "another page"),
    ({"Host": "evil.example"}, "no other name"),
    ({"Host": "localhost.evil.example", "Origin": "http://localhost.evil.example"}, "no other name"),
    ({"Host": "192.168.0.1"}, "no other name"),
    ({"Host": "["}, "not an address"),
    ({"Host": ""}, "no other name"),
]


def test_pages_of_others_and_names_of_others_are_refused(opened):
    upgrade = {
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
    }
    for headers, message in FOREIGN:
        for live in ({}, upgrade):
            answer, text = asked(opened.viewer.port, **headers, **live)
            assert answer.status in (400, 403), headers
            assert message in text.decode()


def test_its_own_page_may_connect_and_no_other_may_frame_it(opened):
    port = opened.viewer.port
    for host in (f"localhost:{port}", f"127.0.0.1:{port}", "localhost:9000", "[::1]:8080"):  # tunnels have other ports
        answer, text = asked(port, Host=host, Origin=f"http://{host}")
        assert (answer.status, b"<html" in text) == (200, True)
        assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'self'"
    with Visitor(port, Origin=f"http://127.0.0.1:{port}") as visitor:
        assert visitor.value("Speed") == 1.0


def test_others_need_the_token_which_becomes_a_cookie():
    viewer = Viewer("0.0.0.0", 0)
    try:
        port, token = viewer.port, viewer.address.partition("?token=")[2]
        assert len(token) > 20
        cookies = ("", "ballbot=wrong", "ballbot=", "a;;=;=")
        for path, cookie in [("/", ""), ("/?token=", ""), ("/?token=wrong", ""), *(("/", each) for each in cookies)]:
            answer, text = asked(port, path, Cookie=cookie)
            assert (answer.status, b"<html" in text) == (401, False)
        answer, _ = asked(port, f"/?token={token}")
        assert (answer.status, answer.headers["Location"]) == (303, "/")
        assert "HttpOnly" in answer.headers["Set-Cookie"]
        cookie = answer.headers["Set-Cookie"].split(";")[0]
        host = "any.example:80"
        assert b"<html" in asked(port, "/", Cookie=cookie, Host=host, Origin=f"http://{host}")[1]
        assert asked(port, "/", Cookie=cookie, Origin="http://evil.example")[0].status == 403
        from websockets.exceptions import InvalidStatus

        with pytest.raises(InvalidStatus, match="401"):
            Visitor(port, arrive=False)
        with Visitor(port, arrive=False, Cookie=cookie) as visitor:
            wait_for(lambda: visitor.packets > 0)
    finally:
        viewer.close()


@pytest.mark.parametrize(("host", "port"), [("192.0.2.1", 8080), ("127.0.0.1", 70_000), ("no.such.host.invalid", 0)])
def test_where_nothing_can_listen_is_said(host, port):
    with pytest.raises(OSError, match="cannot listen on"):
        Viewer(host, port)
