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
from ballbot_train.report.live_page import PlayPage
from ballbot_train.report.simulation import Playground

pytest.importorskip("viser")

from visitor import Visitor, wait_for

MASSES = "error of both masses, %"
STANDING = 3  # a certified episode of Stabilize in which LQR comes to rest


class Opened:
    """A page with a loop that runs in a thread of its own."""

    def __init__(self):
        self.playground = Playground(controller="lqr", physics="rk4", episode=STANDING)
        self.viewer = Viewer(port=0)
        self.port = self.viewer.server.get_port()
        self.page = PlayPage(self.playground, self.viewer)
        self.thread = threading.Thread(target=self.page.run, daemon=True)
        self.thread.start()

    def close(self):
        self.page.stopped = True
        self.thread.join(10)
        assert not self.thread.is_alive()
        self.viewer.close()
        self.playground.close()

    def goes_on(self):
        """Waits for some steps of the simulation."""
        before = len(self.playground.main.forces)
        wait_for(lambda: len(self.playground.main.forces) > before + 5)


@pytest.fixture
def opened():
    page = Opened()
    yield page
    page.close()


@pytest.fixture
def visitor(opened):
    with Visitor(opened.port) as visitor:
        yield visitor


def test_controls_change_the_playground(opened, visitor):
    visitor.change(MASSES, 40.0)
    visitor.change("Speed", 2.0)
    visitor.change("Controller", "shac")
    visitor.change("Episode", "7")
    playground = opened.playground
    wait_for(lambda: playground.episode == 7)
    assert (playground.plant["mass"], opened.page.speed.value, playground.main.name) == (40.0, 2.0, "shac")
    visitor.change("All as the controllers believe")
    wait_for(lambda: playground.plant["mass"] == 0.0 == visitor.value(MASSES))
    visitor.change("Episode", "random")
    wait_for(lambda: playground.episode == "random")
    visitor.change("Task", "orbit")
    wait_for(lambda: visitor.value("Task") == "orbit" and visitor.value("Controller") == "ppo")
    visitor.change("lqr")
    wait_for(lambda: playground.ghosts == ("lqr",))


def test_what_takes_long_is_said_before_it_is_done(opened, visitor, monkeypatch):
    def made(*_):
        wait_for(lambda: "preparing NMPC" in visitor.text())
        raise ValueError("no way")

    monkeypatch.setattr("ballbot_train.report.simulation.make_controller", made)
    visitor.change("Controller", "nmpc")
    wait_for(lambda: "no way" in visitor.text() and visitor.value("Controller") == "lqr")


def test_pushes_come_from_dragging(opened, visitor):
    opened.goes_on()
    for phase in ("start", "end"):
        visitor.drag(phase, 0.5)
    wait_for(lambda: opened.playground.shown_push == pytest.approx([65.0, 0.0]))  # as far as its arrow reaches


def test_everybody_who_has_opened_the_page_may_use_it_and_without_them_nothing_moves(opened, visitor):
    with Visitor(opened.port) as other:
        other.change("Speed", 0.5)
        wait_for(lambda: visitor.value("Speed") == 0.5 == opened.page.speed.value)
    opened.goes_on()
    visitor.connection.close()
    wait_for(lambda: not opened.viewer.server.get_clients())
    time.sleep(0.1)
    left = opened.playground.main.x
    time.sleep(0.2)
    assert opened.playground.main.x == left
    with Visitor(opened.port):
        opened.goes_on()


def test_a_pause_holds_everything(opened, visitor):
    opened.goes_on()
    visitor.press("Play / pause")
    wait_for(lambda: opened.page.paused)
    time.sleep(0.05)
    before = opened.playground.seconds
    time.sleep(0.1)
    assert opened.playground.seconds == before
    visitor.change(" ", "Play / pause")
    opened.goes_on()


def test_what_cannot_be_done_is_said_and_goes_back(opened, visitor):
    visitor.change("Task", "<img src=x onerror=alert(1)>[a](b)")
    wait_for(lambda: "&#60;img src=x onerror=alert(1)&#62;[a]&#40;b)" in visitor.text())
    wait_for(lambda: visitor.value("Task") == "stabilize")
    visitor.change("Speed", 0.0)  # which no slider gives
    visitor.change(MASSES, 1e9)
    wait_for(lambda: "mass must be -40 to 40" in visitor.text() and visitor.value(MASSES) == 0.0)
    opened.goes_on()


@pytest.mark.slow
def test_the_server_ends_when_it_is_told_to(tmp_path):
    code = "from ballbot_train.commands.play import play; play('stabilize', 'lqr', (), port=0, physics='rk4')"
    server = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        port = next(int(found[1]) for line in server.stdout if (found := re.search(r"localhost:(\d+)", line)))
        with Visitor(port) as visitor:
            wait_for(lambda: "LQR, " in visitor.text().replace("\\", ""), 60)
        server.send_signal(signal.SIGTERM)
        assert server.wait(20) == 0
    finally:
        server.kill()
        server.wait()


def asked(port, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    connection.request("GET", "/", headers=headers)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer, text


def test_pages_of_others_and_names_of_others_are_refused(opened):
    from websockets.exceptions import InvalidStatus

    for origin in ("http://evil.example", "null", "http://localhost:1"):
        answer, text = asked(opened.port, Origin=origin)
        assert (answer.status, text) == (403, "another page may not connect")
        with pytest.raises(InvalidStatus, match="403"):
            Visitor(opened.port, Origin=origin)
    for host in ("evil.example", "localhost.evil.example", "192.168.0.1", "[", ""):
        answer, text = asked(opened.port, Host=host, Origin=f"http://{host}")
        assert (answer.status, "no other name" in text) == (403, True), host


def test_its_own_page_may_connect_and_no_other_may_frame_it(opened):
    port = opened.port
    for host in (f"localhost:{port}", f"127.0.0.1:{port}", "localhost:9000", "[::1]:8080"):  # tunnels have other ports
        answer, text = asked(port, Host=host, Origin=f"http://{host}")
        assert (answer.status, "<html" in text) == (200, True)
        assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'self'"
    with Visitor(port, Origin=f"http://127.0.0.1:{port}") as visitor:
        assert visitor.value("Speed") == 1.0


def test_a_port_that_is_none_is_said_and_a_taken_one_is_left_alone(opened):
    with pytest.raises(ValueError, match="port must be 0 to 65535, not 70000"):
        Viewer(70_000)
    other = Viewer(opened.port)
    assert other.server.get_port() > opened.port
    other.close()
