"""The page of the live playground: its controls, and what it does with requests of every kind."""

import re
import signal
import subprocess
import sys
import threading
import time

import pytest
from browser import start_chromium

from ballbot_gym.drawing.viewer import Viewer
from ballbot_train.policy.files import BEST
from ballbot_train.report.live_page import PlayPage
from ballbot_train.report.playground import playground_page
from ballbot_train.report.simulation import Playground

pytest.importorskip("websockets")

from visitor import Visitor, wait_for

MASSES = "error of both masses, %"
STANDING = 3  # a certified episode of Stabilize in which LQR comes to rest


@pytest.fixture(scope="module")
def live():
    """The page, which is the same for every playground."""
    return playground_page(live=True)


class Opened:
    """A page with a loop that runs in a thread of its own."""

    def __init__(self, live):
        self.playground = Playground(controller="lqr", physics="rk4", episode=STANDING)
        self.viewer = Viewer(0, live)
        self.port = self.viewer.port
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
def opened(live):
    page = Opened(live)
    yield page
    page.close()


@pytest.fixture
def visitor(opened):
    with Visitor(opened.port) as visitor:
        yield visitor


def test_controls_change_the_playground(opened, visitor):
    visitor.ask(MASSES, 40.0)
    visitor.ask("speed", 2.0)
    visitor.ask("Controller", "apg")
    visitor.ask("Episode", "7")
    playground = opened.playground
    wait_for(lambda: playground.episode == 7)
    assert (playground.plant["mass"], opened.page.speed, playground.main.name) == (40.0, 2.0, "apg")
    wait_for(lambda: visitor.value(MASSES) == 40.0)
    visitor.ask("Set all to 0")
    wait_for(lambda: playground.plant["mass"] == 0.0 == visitor.value(MASSES))
    visitor.ask("Episode", "random")
    wait_for(lambda: playground.episode == "random")
    visitor.ask("Task", "orbit")
    wait_for(lambda: visitor.value("Task") == "orbit" and visitor.value("Controller") == BEST["orbit"])
    visitor.ask("lqr")
    wait_for(lambda: playground.ghosts == ("lqr",))
    visitor.ask("Restart")
    wait_for(lambda: playground.seconds < 0.5)


def test_a_robot_with_wheels_is_chosen_and_what_it_has_not_is_said(opened, visitor):
    visitor.ask("Robot", "omni")
    wait_for(lambda: visitor.value("Robot") == "omni")
    opened.goes_on()
    wait_for(lambda: visitor.seen["moment"]["look"]["robot"]["wheel_radius"] > 0)
    visitor.ask("push", [5.0, 0.0])
    wait_for(lambda: opened.playground.shown_push is not None)
    visitor.ask("impulse of pushes on the ball, one in 2 s, N·s", 2.0)
    wait_for(lambda: "which Omni does not have" in visitor.value("text"))
    opened.goes_on()


def test_what_takes_long_is_said_before_it_is_done(opened, visitor, monkeypatch):
    def made(*_):
        wait_for(lambda: "preparing NMPC" in visitor.value("text"))
        raise ValueError("no way")

    monkeypatch.setattr("ballbot_train.report.simulation.ControllerName.make", made)
    visitor.ask("Controller", "nmpc")
    wait_for(lambda: "no way" in visitor.value("text") and visitor.value("Controller") == "lqr")


def test_everybody_who_has_opened_the_page_may_use_it_and_without_them_nothing_moves(opened, visitor):
    with Visitor(opened.port) as other:
        other.ask("speed", 0.5)
        wait_for(lambda: visitor.value("speed") == 0.5 == opened.page.speed)
    opened.goes_on()
    visitor.connection.close()
    wait_for(lambda: not opened.viewer.is_watched)
    time.sleep(0.1)
    left = opened.playground.main.x
    time.sleep(0.2)
    assert opened.playground.main.x == left
    with Visitor(opened.port):
        opened.goes_on()


def test_a_pause_holds_everything(opened, visitor):
    opened.goes_on()
    visitor.ask("playing", False)
    wait_for(lambda: opened.page.paused)
    time.sleep(0.05)
    before = opened.playground.seconds
    time.sleep(0.1)
    assert opened.playground.seconds == before
    wait_for(lambda: visitor.value("playing") is False)
    visitor.ask("playing", True)
    opened.goes_on()


REFUSED = [
    *(("Task", value) for value in ("<img src=x>", None, 3, ["orbit"], {"Task": 1})),
    *(("Controller", value) for value in ("runs/secret/policy.json", "/etc/passwd", "apg.json", "nobody")),
    *((MASSES, value) for value in (1e9, float("nan"), float("inf"), "5", True, None, 10**400)),
    *(("speed", value) for value in (0, -1, float("nan"), 1e9)),
    *(("playing", value) for value in (0, "yes", None)),
    *(("push", value) for value in (None, [1], [1, 2, 3], ["1", 2], [float("nan"), 0], [10**400, 0], [True, 0])),
    ("Episode", "200"),
    ("lqr", "on"),
]


def test_what_cannot_be_done_is_said_and_changes_nothing(opened, visitor):
    state = lambda: (opened.playground.plant, opened.page.speed, opened.page.paused, opened.playground.ghosts)  # noqa: E731
    before = state()
    for name, value in REFUSED:
        visitor.ask(name, value)
        wait_for(lambda: opened.playground.notice != "")
        assert opened.playground.notice.count(" ") >= 3, (name, value)  # a sentence
        opened.playground.notice = ""
        time.sleep(0.04)  # it takes 25 messages per second
    for name in ("__class__", "stopped", "close", ""):  # which are no controls
        visitor.ask(name, True)
    opened.goes_on()
    assert state() == before
    assert (visitor.value("Task"), visitor.value("Controller")) == ("stabilize", "lqr")


def test_twenty_thousand_requests_block_neither_the_page_nor_the_simulation(opened, visitor):
    with Visitor(opened.port) as flooding:
        for i in range(20_000):
            flooding.ask("Task", ("orbit", "stabilize")[i % 2])
        visitor.ask("speed", 0.5)
        wait_for(lambda: opened.page.speed == 0.5, 10)
        opened.goes_on()


@pytest.fixture
def browser(tmp_path):
    driver = start_chromium(tmp_path / "chromium", "1000,800")
    yield driver
    assert [entry["message"] for entry in driver.get_log("browser") if entry["level"] == "SEVERE"] == []
    driver.quit()


def test_in_the_browser_the_page_shows_the_stream_and_the_scenarios_and_a_drag_pushes(opened, browser):
    from selenium.webdriver import ActionChains

    browser.get(opened.viewer.address)
    chips = "return [...document.querySelectorAll('.chips button')].map((chip) => chip.textContent)"
    wait_for(lambda: browser.execute_script(chips) == ["Live", "Push", "Throw", "Orbit", "Turn", "Weave"])
    wait_for(lambda: browser.execute_script("return playground.moment.robots.length") == 1)
    wait_for(lambda: "LQR" in browser.find_element("css selector", ".readouts tbody").text)
    assert browser.find_element("css selector", ".names div").text.startswith("LQR")
    assert not browser.find_element("css selector", ".drive").is_displayed()
    browser.find_element("css selector", ".play").click()
    wait_for(lambda: opened.page.paused)
    opened.playground.begin("rest")
    wait_for(lambda: browser.execute_script("return playground.moment.robots[0].x.every((value) => value === 0)"))
    wait_for(lambda: browser.execute_script("return Math.hypot(...playground.scene.camera.target.slice(0, 2)) < 0.01"))
    where = "return playground.scene.project([0, 0, 0.7])"
    size = "return [playground.scene.canvas.clientWidth, playground.scene.canvas.clientHeight]"
    (x, y), (width, height) = browser.execute_script(where), browser.execute_script(size)
    actions = ActionChains(browser)
    view = browser.find_element("css selector", ".view")
    actions.move_to_element_with_offset(view, int(x - width / 2), int(y - height / 2))
    actions.click_and_hold().move_by_offset(120, 0).release().perform()
    wait_for(lambda: opened.playground.shown_push is not None)
    right = browser.execute_script("return playground.scene.right")
    assert opened.playground.shown_push @ right[:2] > 10
    browser.execute_script("[...document.querySelectorAll('.chips button')][2].click()")  # Throw
    wait_for(lambda: not opened.viewer.is_watched)
    assert browser.find_element("css selector", ".drive").is_displayed()
    assert not browser.find_element("css selector", ".panel").is_displayed()
    browser.execute_script("[...document.querySelectorAll('.chips button')][0].click()")
    wait_for(lambda: opened.viewer.is_watched)


def test_in_the_browser_controls_ask_for_changes_and_show_them(opened, browser):
    browser.get(opened.viewer.address)
    wait_for(lambda: browser.execute_script("return playground.stream.controls.has('Task')"))
    change = """
    const { input } = playground.stream.controls.get(arguments[0]);
    if (input.type === "button") return input.click();
    if (input.type === "checkbox") input.checked = arguments[1];
    else input.value = arguments[1];
    input.dispatchEvent(new Event("input"));
    """
    browser.execute_script(change, MASSES, 20)
    wait_for(lambda: opened.playground.plant["mass"] == 20)
    browser.execute_script(change, "Set all to 0", True)
    wait_for(lambda: opened.playground.plant["mass"] == 0)
    browser.execute_script(change, "apg", True)
    wait_for(lambda: opened.playground.ghosts == ("apg",))
    browser.execute_script(change, "Task", "weave")
    wait_for(lambda: opened.playground.world.task_name == "weave")
    shown = "return [playground.stream.controls.get('Task').input.value, playground.moment.markers.length]"
    wait_for(lambda: browser.execute_script(shown)[0] == "weave" and browser.execute_script(shown)[1] > 1)
    browser.execute_script(
        "const s = document.querySelector('.speed'); s.value = '0.25'; s.dispatchEvent(new Event('change'))"
    )
    wait_for(lambda: opened.page.speed == 0.25)
    unnamed = """
    return [...document.querySelectorAll("button, input, select, canvas")].filter((control) =>
      !(control.textContent.trim() || control.getAttribute("aria-label") || control.labels?.[0]?.textContent.trim()))
      .map((control) => control.className)
    """
    assert browser.execute_script(unnamed) == []


@pytest.mark.slow
def test_the_server_ends_when_it_is_told_to(tmp_path):
    code = "from ballbot_train.commands.play import play; play('stabilize', 'lqr', (), port=0, physics='rk4')"
    server = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        port = next(int(found[1]) for line in server.stdout if (found := re.search(r"localhost:(\d+)", line)))
        with Visitor(port) as visitor:
            wait_for(lambda: visitor.seen.get("status", {"rows": []})["rows"], 60)
        server.send_signal(signal.SIGTERM)
        assert server.wait(20) == 0
    finally:
        server.kill()
        server.wait()
