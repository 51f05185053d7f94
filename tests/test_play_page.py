"""The page of the playground: its controls, who drives, what comes from outside, and how it looks in a browser."""

import contextlib
import http.client
import socket
import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from browser import start_chromium

from ballbot_gym.trajectory import Trajectory
from ballbot_gym.viewer import Viewer
from ballbot_train.play.gate import Gate
from ballbot_train.play.page import PlayPage, _film
from ballbot_train.play.playground import Playground
from ballbot_train.policy_files import SHIPPED

viser = pytest.importorskip("viser")

STANDING = 3  # a certified episode of Stabilize in which LQR comes to rest


class Opened:
    """A page with a loop that runs in a thread of its own."""

    def __init__(self, out: Path, port: int = 0, **keywords):
        self.playground = Playground(**{"controller": "lqr", "physics": "rk4", "episode": STANDING} | keywords)
        self.viewer = Viewer(port=port)
        self.page = PlayPage(self.playground, self.viewer, out)
        self.thread = threading.Thread(target=self.page.run, daemon=True)
        self.thread.start()

    def close(self):
        self.page.stop()
        self.thread.join(10)
        assert not self.thread.is_alive()
        self.page.close()
        self.viewer.close()
        self.playground.close()

    def control(self, label):
        """The control with this label."""
        handles = self.viewer.server.gui._gui_input_handle_from_uuid.values()
        return next(handle for handle in handles if getattr(handle, "label", None) == label)

    def change(self, label, value, client_id=0):
        """What viser does when a browser changes a control."""
        control = self.control(label)
        control._impl.value = value
        for callback in control._impl.update_cb:
            callback(SimpleNamespace(client_id=client_id, client=None, target=control))

    def do(self, action):
        """Does something between two steps of the loop, and waits for it."""
        done = threading.Event()
        self.page._requests.put(lambda: (action(), done.set()))
        assert done.wait(10)


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)


@pytest.fixture
def opened(tmp_path):
    page = Opened(tmp_path)
    yield page
    page.close()


# --- controls ---


def test_controls_change_the_playground(opened):
    opened.change("Masses, %", 50.0)
    opened.change("Speed", 2.0)
    opened.change("effort × 10^", 1.0)
    opened.change("Controller", "you")
    opened.change("Certified episode", 7)
    playground = opened.playground
    wait_for(lambda: playground.episode == 7)
    assert playground.plant["mass"] == 50.0
    assert opened.page.clock.speed == 2.0
    assert playground.weights["effort_weight"] == pytest.approx(10 * playground.base.effort_weight)
    assert playground.controller == "you"


def test_a_policy_file_becomes_a_controller_that_can_be_chosen(opened):
    path = str(SHIPPED / "stabilize-shac.json")
    opened.change("Policy file", path)
    wait_for(lambda: opened.playground.main.name == path, 60)
    assert opened.control("Controller").value == "stabilize-shac"
    opened.change("Controller", "LQR")
    wait_for(lambda: opened.control("Policy file").value == "")
    opened.change("Policy file", "nowhere.json")
    wait_for(lambda: opened.control("Policy file").value == "")
    assert "unknown controller 'nowhere.json'" in opened.playground.notice


def test_another_task_brings_its_own_controllers_and_weights(opened):
    opened.change("Task", "orbit")
    wait_for(lambda: opened.page._task_shown[0] == "orbit")
    assert opened.control("radius × 10^").value == 0.0
    assert "DAgger" in opened.control("Controller").options


def test_a_push_comes_from_the_sliders(opened):
    opened.do(lambda: None)
    wait_for(lambda: len(opened.playground.main.samples) > 1)
    opened.page._impulse.value, opened.page._bearing.value = 20.0, 90
    opened.do(opened.page._push)
    wait_for(lambda: opened.playground.drawing().robots[-1].push is not None)
    assert opened.playground.drawing().robots[-1].push == pytest.approx([0, 1000.0], abs=1e-9)  # N for 20 ms


def test_who_watches_changes_nothing_until_he_takes_over(opened):
    opened.change("Speed", 0.5, client_id=1)  # the first who touches anything drives
    wait_for(lambda: opened.page.clock.speed == 0.5)
    opened.change("Speed", 2.0, client_id=2)
    wait_for(lambda: opened.control("Speed").value == 0.5)  # it goes back
    assert opened.page.clock.speed == 0.5
    opened.page._take_over(2)
    opened.change("Speed", 2.0, client_id=2)
    wait_for(lambda: opened.page.clock.speed == 2.0)
    opened.page._on_disconnect(SimpleNamespace(client_id=2))
    opened.change("Speed", 1.0, client_id=1)
    wait_for(lambda: opened.page.clock.speed == 1.0)


@pytest.mark.parametrize(
    ("label", "value"),
    [
        ("Speed", float("nan")),
        ("Speed", -1.0),
        ("Masses, %", float("inf")),
        ("effort × 10^", 1e9),
        ("effort × 10^", float("nan")),
        ("Task", "dance"),
        ("Controller", "../../etc/passwd"),
        ("Certified episode", float("nan")),
        ("Certified episode", -5),
        ("At the end", "explode"),
    ],
)
def test_what_makes_no_sense_is_refused_and_goes_back(opened, label, value):
    before = opened.control(label).value
    opened.change(label, value)
    wait_for(lambda: opened.control(label).value == before)
    assert opened.thread.is_alive()


def test_dragging_pushes_where_a_controller_acts_and_steers_where_a_human_drives(opened):
    pushed = []
    opened.playground.push = lambda x, y: pushed.append((x, y))
    for phase in ("start", "update", "end"):
        opened.page._on_grab(0, phase, np.array([0.5, 0.0]))
    wait_for(lambda: pushed)
    assert pushed == [(5.0, 0.0)]
    opened.change("Controller", "you")
    wait_for(lambda: opened.playground.is_driven)
    opened.page._on_grab(0, "update", np.array([0.5, 0.0]))
    wait_for(lambda: opened.playground.stick.value == (0.5, 0.0))
    opened.page._on_grab(0, "end", np.array([0.5, 0.0]))
    wait_for(lambda: opened.playground.stick.value == (0.0, 0.0))


def test_a_pause_holds_everything_and_a_step_moves_once(opened):
    wait_for(lambda: len(opened.playground.main.samples) > 1)
    opened.do(opened.page._toggle)
    time.sleep(0.05)
    before = opened.playground.seconds
    time.sleep(0.1)
    assert opened.playground.seconds == before
    opened.do(opened.page._one_step)
    wait_for(lambda: opened.playground.seconds > before)
    assert opened.playground.seconds == pytest.approx(before + 0.02)


def test_files_are_saved_and_handed_to_the_browser(opened, tmp_path):
    wait_for(lambda: len(opened.playground.main.samples) > 3)
    sent = []
    client = SimpleNamespace(send_file_download=lambda name, content, **_: sent.append((name, len(content))))
    opened.do(lambda: opened.page._save_trajectory(client))
    assert sent[0][0] == "stabilize-lqr-1.npz"
    assert len(Trajectory.load(tmp_path / sent[0][0]).u) > 3


def test_a_film_of_what_happened_is_drawn(tmp_path):
    playground = Playground(controller="lqr", physics="rk4", episode=STANDING)
    playground.settle()
    for _ in range(6):
        playground.step()
    assert _film(playground.replay(), tmp_path / "film.webp").stat().st_size > 1000
    playground.close()


# --- from outside ---


def raw_client(port):
    from websockets.sync.client import connect

    return connect(f"ws://127.0.0.1:{port}", subprotocols=[f"viser-v{viser.__version__}"], max_size=None)


def test_garbage_from_the_network_harms_nothing(opened):
    import msgspec

    port = opened.viewer.port
    wait_for(lambda: len(opened.playground.main.samples) > 1)
    for message in ("text", b"", b"\x00" * 100, msgspec.msgpack.encode({"type": "NoSuchMessage"})):
        with raw_client(port) as client:
            client.send(message)
    speed, mass = opened.control("Speed"), opened.control("Masses, %")
    with raw_client(port) as client:
        for uuid, value in ((speed._impl.uuid, "fast"), (mass._impl.uuid, None), (mass._impl.uuid, [1, 2]), ("no", 1)):
            update = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
            client.send(msgspec.msgpack.encode(update))
    with socket.create_connection(("127.0.0.1", port)) as plain:
        plain.sendall(b"GET /../../etc/passwd HTTP/1.1\r\n\r\n")
    before = opened.playground.seconds_in_all
    wait_for(lambda: opened.playground.seconds_in_all > before + 0.1)
    assert opened.page.clock.speed == 1.0
    assert opened.playground.plant["mass"] == 0.0
    with raw_client(port) as client:
        assert client.recv(timeout=5)


class Inner(BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Length", "6")
        self.end_headers()
        self.wfile.write(b"inside")

    def log_message(self, *arguments):
        pass


@pytest.fixture
def gate():
    server = HTTPServer(("127.0.0.1", 0), Inner)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    gate = Gate("127.0.0.1", 0, server.server_address[1])
    yield gate
    gate.close()
    gate.close()
    server.shutdown()
    server.server_close()


def asked(gate, path, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", gate.port, timeout=5)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    text = answer.read()
    connection.close()
    return answer, text


def test_nobody_passes_the_gate_without_its_token(gate):
    for path, headers in (
        ("/", {}),
        ("/?token=", {}),
        ("/?token=wrong", {}),
        ("/", {"Cookie": "ballbot=wrong"}),
        ("/", {"Cookie": "ballbot="}),
        ("/", {"Cookie": "\x01;;=;="}),
    ):
        answer, text = asked(gate, path, **headers)
        assert answer.status == 401
        assert b"inside" not in text


def test_the_token_becomes_a_cookie_that_opens_the_gate(gate):
    answer, _ = asked(gate, f"/?token={gate.token}")
    assert (answer.status, answer.headers["Location"]) == (303, "/")
    assert "HttpOnly" in answer.headers["Set-Cookie"]
    cookie = answer.headers["Set-Cookie"].split(";")[0]
    assert asked(gate, "/", Cookie=cookie)[1] == b"inside"
    own = f"http://127.0.0.1:{gate.port}"
    assert asked(gate, "/", Cookie=cookie, Origin=own, Host=own.removeprefix("http://"))[1] == b"inside"
    assert asked(gate, "/", Cookie=cookie, Origin="http://evil.example")[0].status == 403
    assert gate.token in gate.address


def test_the_page_and_its_live_connection_pass_the_gate(opened):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    gate = Gate("127.0.0.1", 0, opened.viewer.port)
    try:
        assert b"<html" in asked(gate, "/", Cookie=f"ballbot={gate.token}")[1]
        live = f"ws://127.0.0.1:{gate.port}", [f"viser-v{viser.__version__}"]
        with pytest.raises(InvalidStatus, match="401"):
            connect(live[0], subprotocols=live[1])
        cookie = {"Cookie": f"ballbot={gate.token}"}
        with connect(live[0], subprotocols=live[1], additional_headers=cookie, max_size=None) as client:
            assert client.recv(timeout=10)
    finally:
        gate.close()


def test_what_is_no_request_is_dropped(gate):
    for sent in (b"\x16\x03\x01 tls?", b"GET\r\n\r\n", b"x" * 70_000):
        with socket.create_connection(("127.0.0.1", gate.port), timeout=5) as plain:
            plain.sendall(sent)
            plain.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionError):
                assert b"inside" not in plain.recv(1000)
    assert asked(gate, "/")[0].status == 401


# --- in a browser ---


@pytest.fixture
def chromium(tmp_path_factory):
    started = []

    def start():
        browser = start_chromium(
            tmp_path_factory.mktemp("chromium"), "640,480", "use-gl=angle", "use-angle=swiftshader"
        )
        started.append(browser)
        return browser

    yield start
    for browser in started:
        browser.quit()


def shown(browser, words, seconds=120.0):
    """Waits until the page's text has these words."""
    wait_for(lambda: words in browser.execute_script("return document.body.innerText"), seconds)


def focus(browser, has):
    """Whether the page has the focus; without it viser's page does not try again where its first connection fails."""
    browser.execute_cdp_cmd("Emulation.setFocusEmulationEnabled", {"enabled": has})


def choose(browser, present, wanted):
    """Chooses another controller in the page, as a hand does."""
    from selenium.webdriver.support.ui import WebDriverWait

    find = "return [...document.querySelectorAll('input')].filter(i => i.value == arguments[0])[0]"
    offered = (
        "return [...document.querySelectorAll('[role=option]')].filter(o => o.innerText.trim() == arguments[0])[0]"
    )
    browser.execute_script(find, present).click()
    option = WebDriverWait(browser, 60).until(lambda _: browser.execute_script(offered, wanted))
    browser.execute_script("arguments[0].click()", option)


def watched(opened):
    """A list that gets the place of the robot after every step from now on."""
    places, step = [], opened.playground.step

    def recorded():
        moved = step()
        places.append(opened.playground.main.x[:2])
        return moved

    opened.playground.step = recorded
    return places


def severe(browser):
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


@pytest.mark.slow
def test_two_browsers_watch_and_drive_through_reload_and_restart(opened, chromium, tmp_path):
    one, two = chromium(), chromium()
    port = opened.viewer.port
    address = f"{opened.viewer.address}/?fixedDpr=0.1"  # large pixels, because the processor draws them
    for browser in (one, two):
        focus(browser, True)
    one.get(address)
    shown(one, "LQR")
    wait_for(lambda: len(opened.viewer.server.get_clients()) == 1)
    two.get(address)
    shown(two, "Take the controls")
    shown(one, "2 browsers show this page")

    # a push makes the robot lean
    push = "return [...document.querySelectorAll('button')].filter(b => b.innerText.trim() == 'Push')[0].click()"
    opened.do(lambda: None)
    two.execute_script(push)  # it watches: nothing happens
    time.sleep(1.0)
    before = max(sample.tilt for sample in list(opened.playground.main.samples)[-20:])
    opened.do(lambda: opened.playground.set_ghosts(["you"]))
    one.execute_script(push)
    wait_for(lambda: opened.playground.main.samples[-1].tilt > max(before, np.radians(4)), 60)
    assert opened.playground._runners["you"].samples

    # the ghost gets the push too, and the driver chooses another controller: the robot goes on where it is
    leaning = [sample.tilt for sample in opened.playground._runners["you"].samples]
    assert max(leaning[-200:]) > np.radians(4)
    opened.do(lambda: opened.playground.set_ghosts([]))
    places = watched(opened)
    choose(one, "LQR", "you")
    wait_for(lambda: opened.playground.main.name == "you", 60)
    choose(one, "you", "LQR")
    wait_for(lambda: opened.playground.main.name == "lqr", 60)
    assert np.abs(np.diff(places, axis=0)).max() < 0.02 * 8  # m: a control step at less than 8 m/s

    # a reload in the middle: the page comes back, and whoever acts first drives
    one.refresh()
    shown(one, "LQR")
    assert opened.thread.is_alive()
    for browser in (one, two):
        assert severe(browser) == []

    # the server is stopped and started: the pages come back by themselves, even those that have not the focus
    for browser in (one, two):
        focus(browser, False)
    opened.close()
    again = Opened(tmp_path, port=port, task="orbit")
    try:
        assert again.viewer.port == port
        wait_for(lambda: len(again.viewer.server.get_clients()) == 2, 120)
        shown(one, "of 8 s")
    finally:
        again.close()
        opened.__init__(tmp_path)  # for the fixture to close
