"""The report page, as text and in a browser."""

import json
import re
import time

import numpy as np
import pytest
from browser import start_chromium
from builders import result

from ballbot_gym import files
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.trajectory import Trajectory
from ballbot_train.report import figures
from ballbot_train.report.film import film_frames, write_film
from ballbot_train.report.page import report_page
from ballbot_train.report.replay import Replay, Take, telling_episode

HEADER = ["task", "controller", "regret", "falls"]
ROWS = [
    ["stabilize", "lqr", "38.02%", "64/200"],
    ["stabilize", "nmpc", "-0.08%", "0/200"],
    ["turn", "lqr", "–", "200/200"],
    ["turn", "nmpc", "9.5%", "9/200"],
]


def leaning(to, seconds):
    steps = round(seconds / 0.02)
    x = np.zeros((steps + 1, 8))
    x[:, 0], x[:, 2] = np.linspace(-1, 1, steps + 1), np.linspace(0, to, steps + 1)
    return Trajectory(0.02 * np.arange(steps + 1), x, np.full((steps, 2), 50.0))


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A page with every kind of section."""
    folder = tmp_path_factory.mktemp("report")
    markers = (Marker((1.0, 0.5), 0.3, 0.25, (0.7, 0.1, 0.1, 1.0)), Marker((0, 0), 1.0, 0.03, (0.8, 0.1, 0.1, 1), True))
    takes = (
        Take("LQR", leaning(1.0, 0.6), "#c0392b", "fails", failed=True),
        Take("NMPC", leaning(0.3, 1.0), "#e08a00"),
    )
    replays = [Replay("first", takes, markers), Replay("second", takes[1:])]
    curve = Take("a", leaning(0.3, 1.0), "#1f6fb2")
    picture = figures.save(figures.trajectory_figure("a figure", [curve]), folder / "pictures" / "some-figure.png")
    pictures = {"Pictures": [picture], "Nothing": []}
    text = report_page("A <title>", replays, HEADER, ROWS, pictures, {"commit": "abc"})
    return files.write(folder / "report.html", text)


def test_the_page_holds_everything_it_shows(page):
    text = page.read_text()
    markup = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    sources = re.findall(r'(?:src|href)="([^"]{0,40})', markup)
    assert sources
    assert [source for source in sources if not source.startswith(("data:", "#"))] == []


def test_what_has_no_data_has_no_section(page):
    assert "Nothing" not in page.read_text()
    assert "Watch an episode" not in report_page("t", [Replay("r", ())], HEADER, ROWS)


def test_names_with_markup_quotes_and_ampersands_are_escaped(tmp_path):
    name = """<script>alert('"a" & b')</script>"""
    take = Take(name, leaning(0.1, 0.1), "red", note=name)
    pictures = {name: [figures.save(figures.trajectory_figure(name, [take]), tmp_path / "'a\"&.png")]}
    replays, table = [Replay(name, (take,))], ([name], [[name, name]])
    text = report_page(name, replays, *table, pictures, {name: name})
    assert "alert" in text
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(&#39;&#34;a&#34; &amp; b&#39;)&lt;/script&gt;" in text
    assert 'alt="&#39;a&#34;&amp;"' in text
    for data in re.findall(r'<script type="application/json">(.*?)</script>', text, flags=re.DOTALL):
        assert not set("<>&'") & set(data)
        json.loads(data)


def test_names_are_text_in_figures(tmp_path):
    name = "<b><a href='https://x.y'>$\\frac{1}$ & $x"
    take = Take(name, leaning(0.1, 0.1), "red", name)
    assert figures.save(figures.trajectory_figure(name, [take]), tmp_path / "a.png").stat().st_size > 1000
    write_film(film_frames(Replay(name, (take,)), [0.0, 0.1], 64), tmp_path / "a.webp")


def test_the_telling_episode_is_the_first_in_which_one_controller_fails_and_another_does_not():
    fails = [(True, True), (False, False), (False, True), (True, False)]
    results = [result(episode=i, failure=failure) for i, both in enumerate(fails) for failure in both]
    assert telling_episode("stabilize", results) == 2
    assert telling_episode("stabilize", results[:4]) == 0


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    browser = start_chromium(tmp_path_factory.mktemp("chromium"), "1280,1600")
    yield browser
    browser.quit()


@pytest.fixture
def opened(chromium, page):
    """The page, just opened, in a wide window; afterwards its console held no error."""
    chromium.get(page.as_uri())
    wait_for(chromium, "return document.querySelector('.replay').dataset.ready === 'true'")
    yield chromium
    assert [entry["message"] for entry in chromium.get_log("browser") if entry["level"] == "SEVERE"] == []


def wait_for(browser, condition, seconds=60):
    end = time.monotonic() + seconds
    while not browser.execute_script(condition):
        assert time.monotonic() < end, condition
        time.sleep(0.05)


def column(browser, i):
    return browser.execute_script(
        f"return [...document.querySelectorAll('tbody tr')].map(row => row.cells[{i}].textContent)"
    )


def press(browser, text):
    browser.execute_script(
        "[...document.querySelectorAll('button')].find(button => button.textContent === arguments[0]).click()", text
    )


def scrub(browser, t):
    browser.execute_script(
        "const bar = document.querySelector('.scrub'); bar.value = arguments[0]; bar.dispatchEvent(new Event('input'))",
        t,
    )


def tilts(browser):
    return browser.execute_script("return [...document.querySelectorAll('.tilt')].map(e => e.textContent)")


PICTURES = """
const { replay } = document.querySelector(".replay");
replay.draw();
return replay.episode.takes.map((_, n) => {
  const { gl, canvas } = replay.stages[n].scene, pixels = new Uint8Array(4 * canvas.width * canvas.height);
  gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  const colors = new Uint32Array(pixels.buffer);
  return [new Set(colors).size, colors.reduce((sum, color, i) => (sum + (i % 997) * (color % 1009)) % 1e9, 0)];
})
"""
"""How many colours the picture of each take has, and a sum that tells pictures apart."""


def test_the_table_sorts_by_numbers_and_keeps_what_is_missing_last(opened):
    press(opened, "regret")
    assert column(opened, 2) == ["-0.08%", "9.5%", "38.02%", "–"]
    press(opened, "regret")
    assert column(opened, 2) == ["38.02%", "9.5%", "-0.08%", "–"]
    press(opened, "controller")
    assert column(opened, 1) == ["lqr", "lqr", "nmpc", "nmpc"]
    heads = "return [...document.querySelectorAll('th')].map(head => head.getAttribute('aria-sort'))"
    assert opened.execute_script(heads) == [None, "ascending", None, None]


def test_the_first_picture_is_the_greatest_lean_of_a_robot_that_does_not_fall_and_scrubbing_moves_every_robot(opened):
    assert tilts(opened) == ["57°", "17°"]
    scrub(opened, 0)
    assert tilts(opened) == ["0°", "0°"]
    before = opened.execute_script(PICTURES)
    assert all(colors > 200 for colors, _ in before)  # a blank one has one
    scrub(opened, 0.8)
    assert tilts(opened) == ["57°", "14°"]  # the first has ended, at 1 rad
    after = opened.execute_script(PICTURES)
    assert all(a[1] != b[1] for a, b in zip(before, after, strict=True))


def test_playing_moves_until_the_end_and_pauses_where_it_is_told(opened):
    scrub(opened, 0)  # from where the film takes four seconds, time enough to press
    clock = "return document.querySelector('.clock').textContent"
    opened.execute_script("document.querySelector('.speed').value = '0.25'")
    press(opened, "Play")
    wait_for(opened, "return parseFloat(document.querySelector('.clock').textContent) > 0.05")
    press(opened, "Pause")
    held = opened.execute_script(clock)
    time.sleep(0.3)
    assert opened.execute_script(clock) == held < "1"
    opened.execute_script("document.querySelector('.speed').value = '2'")
    press(opened, "Play")
    wait_for(opened, f"{clock} === '1.00 s'")
    wait_for(opened, "return document.querySelector('.play').textContent === 'Play'")


def test_a_drag_turns_every_camera(opened):
    from selenium.webdriver import ActionChains

    yaws = "return document.querySelector('.replay').replay.stages.map(stage => stage.scene.camera.yaw)"
    before = opened.execute_script(yaws)
    ActionChains(opened).drag_and_drop_by_offset(opened.find_element("css selector", ".view"), 50, 0).perform()
    assert opened.execute_script(yaws) == pytest.approx([yaw - 0.4 for yaw in before])


def test_another_episode_has_its_own_scenes(opened):
    press(opened, "second")
    wait_for(opened, "return document.querySelectorAll('.view').length === 1")
    assert tilts(opened) == ["17°"]


@pytest.mark.parametrize("width", [360, 800, 1600])
def test_the_page_fits_its_window(chromium, page, width):
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    chromium.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    chromium.get(page.as_uri())
    wait_for(chromium, "return document.querySelector('.replay').dataset.ready === 'true'")
    needed, inner = chromium.execute_script("return [document.documentElement.scrollWidth, innerWidth]")
    assert needed <= inner == width  # less where there is a scroll bar
    chromium.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
