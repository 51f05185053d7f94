// The playground's page: scenarios that the browser computes, pushes, driving and readouts, on the page of page.js.
"use strict";

const DEGREES = 180 / Math.PI;
const PUSH_SHOWN = 0.5; // s of the episode, for which a push's arrow stays
const COUNTDOWN = 3; // s, before a drive begins
const THUMB = 70; // px of a drag that holds the stick fully out

class Playground extends Page {
  constructor() {
    super();
    for (const title of new Set(DATA.scenarios.map((scenario) => scenario.title))) {
      this.addChip(title, () => this.open(DATA.scenarios.findIndex((scenario) => scenario.title === title)));
    }
    this.find("episode").onchange = (event) => this.open(Number(event.target.value), this.driver !== null);
    this.find("drive").onclick = () => this.open(this.index, this.driver === null || this.given !== null);
    this.sliders = Object.entries(DATA.unknown).map(([name, bounds]) => this.slider(name, bounds));
    this.find("known").onclick = () => this.setRobot(KNOWN);
    this.find("drawn").onclick = () => this.setRobot(this.sliders.map(({ min, max }) => (+min + Math.random() * (max - min)) / 100));
    this.setRobot(KNOWN, 0);
    this.openLinked();
    window.onhashchange = () => this.openLinked();
  }

  /** A slider for a factor of the robot, %. */
  slider(name, [low, high]) {
    const [label, input] = ["label", "input"].map((tag) => document.createElement(tag));
    Object.assign(input, { type: "range", min: Math.round(100 * low), max: Math.round(100 * high), value: 100 });
    input.oninput = () => this.setRobot();
    label.append(`${name} `, input, document.createElement("output"));
    this.find("drawn").before(label);
    return input;
  }

  /** Replays the drive of a link; an address without one changes nothing. */
  openLinked() {
    const [task, episode, robot = "", letters = ""] = location.hash.replace("#drive=", "").split(".");
    const index = DATA.scenarios.findIndex((scenario) => scenario.task === task && String(scenario.episode) === episode);
    const [factors, drive] = [robot.split("-").map((percent) => Number(percent) / 100), unpackedDrive(letters)];
    if (index < 0 || !drive || factors.length !== KNOWN.length || !factors.every(Number.isFinite)) return;
    this.setRobot(factors, index);
    this.open(index, true, drive);
  }

  /** The address of this page that replays the drive. */
  get link() {
    const { task, episode } = this.scenario;
    const robot = this.sliders.map(({ value }) => value).join("-");
    return `${location.href.split("#")[0]}#drive=${[task, episode, robot, packedDrive(this.driver.drive)].join(".")}`;
  }

  /** The robot's factors, from the sliders unless they are given. Opens the scenario again. */
  setRobot(factors = null, index = this.index) {
    this.sliders.forEach((slider, i) => {
      if (factors) slider.value = Math.round(100 * factors[i]);
      slider.nextElementSibling.textContent = `${slider.value} %`;
    });
    this.robot = this.sliders.map((slider) => Number(slider.value) / 100);
    this.isKnown = this.robot.every((factor) => factor === 1);
    this.find("known").disabled = this.isKnown;
    this.open(index, Boolean(this.driver));
  }

  /** Opens a scenario. A drive needs an episode with an optimum, and may be given, by a link. */
  open(index, driven = false, given = null) {
    if (driven && DATA.scenarios[index].optimum === null) index = DATA.scenarios.findIndex((scenario) => scenario.optimum !== null);
    this.index = index;
    this.scenario = DATA.scenarios[index];
    const { title, task } = this.scenario;
    this.stream?.close();
    this.setOpen(title, false);
    this.find("controls").hidden = false;
    this.find("clock").textContent = "";
    const same = [...DATA.scenarios.entries()].filter(([, scenario]) => scenario.title === title);
    this.find("episode").replaceChildren(...same.map(([i, { episode }]) => new Option(episode ?? "at rest", i, false, i === index)));
    this.find("text").textContent = given
      ? "A drive is replayed. Drive it yourself, and do better."
      : driven
      ? "You drive against the optimum: the stick is the robot's lean. Arrow keys or W A S D, or drag in the picture. " +
        "The blue arrow shows the way. The regret is what you end with if the policy takes over now."
      : `${this.scenario.text} Drag a robot to push it, or the floor to look around.`;
    this.find("drive").setAttribute("aria-pressed", driven && !given);
    this.given = given;
    this.driver = given ? new Replayed(given) : driven ? new Driver() : null;
    this.countdown = driven && !given ? COUNTDOWN : 0;
    this.held = new Set(); // keys
    this.robots = robotsOf(this.scenario, this.driver, this.robot);
    // the page has the optima of the robot that everybody knows, and a regret over them would be one over something else
    this.best = this.isKnown && this.scenario.best && new Optimum(this.scenario);
    this.guide = this.driver && new Guide(this.scenario);
    const { label, color } = DATA.policies[task];
    const learned = { label: `${label} policy`, color, alpha: 1 };
    const ghost = DATA.ghost_opacity + 0.15;
    const driver = { ...DATA.you, alpha: 1, label: given ? "driver" : DATA.you.label };
    const looks = driven ? [driver, { ...learned, alpha: ghost }] : [learned, { ...DATA.lqr, alpha: ghost }];
    this.everyone = this.best ? [...this.robots, this.best] : this.robots;
    this.everyone.forEach((robot, i) => (robot.look = looks[i] ?? { ...DATA.best, alpha: DATA.ghost_opacity }));
    this.due = this.scenario.push; // the push that comes by itself
    this.restart(this.scenario.state);
    const [x, y] = this.scenario.state;
    this.scene.camera.target = [x, y, 0.5];
    this.setPlaying(true);
    if (driven && !given) this.find("view").focus({ preventScroll: true }); // the keys are for the robot from now on
  }

  /** All robots in one state, at time 0. */
  restart(state) {
    for (const robot of this.everyone) robot.reset(state);
    this.forecast = this.driver && new Forecast(this.robots[0], this.scenario);
    this.disturbed = false; // by a push: a regret is that of an undisturbed episode
    this.time = 0;
    this.late = 0; // s of the episode that are not computed yet
    this.shown = null; // the push whose arrow is shown: {impulse, until}
  }

  /** One control step of all robots. */
  advance() {
    if (this.due && this.time >= this.due[0] - 1e-9) {
      const [, impulse, bearing] = this.due;
      this.due = null;
      this.hit([impulse * Math.cos(bearing), impulse * Math.sin(bearing)]);
    }
    for (const robot of this.everyone) robot.advance();
    this.forecast?.advance();
    this.time += DATA.dt;
    if (this.driver && this.playing && this.robots[0].over) this.end();
  }

  /** Ends a drive with a sentence, and a link that shows it to others. */
  end() {
    this.setPlaying(false);
    const [mine, policy] = this.robots;
    const seconds = (mine.steps * DATA.dt).toFixed(1);
    const did = verdict(mine) ? `${verdict(mine)} after ${seconds} s` : `stood until the end, for ${seconds} s`;
    const shares = [mine, policy].map((robot) => (robot.over ? this.regret(robot) : ""));
    const rival = shares[1] && `; ${policy.look.label}: ${shares[1]}`;
    const link = document.createElement("a");
    Object.assign(link, { className: "link", href: this.link, target: "_blank", textContent: "Link to this drive" });
    const who = this.given ? "The driver" : "You";
    const sentence = shares[0] ? `${who} ${did}: ${shares[0]}${rival}.` : `${who} ${did}.`;
    this.find("text").replaceChildren(`${sentence} Anyone who opens this link sees the drive: `, link);
  }

  /** A push for every robot. If one has fallen, all start again first. */
  hit(impulse) {
    if (this.isLive) return super.hit(impulse);
    if (!(Math.hypot(...impulse) > 0)) return;
    const bounded = shortened(impulse, STRONGEST);
    if (this.robots.some((robot) => robot.ended)) this.restart(this.scenario.state);
    this.due = null;
    this.disturbed = true;
    for (const robot of this.robots) robot.hit(bounded);
    this.shown = { impulse: bounded, until: this.time + PUSH_SHOWN };
    if (!this.playing) this.setPlaying(true);
  }

  reset() {
    if (this.isLive) super.reset();
    else this.open(this.index, this.driver !== null, this.given);
  }

  tick(seconds, elapsed) {
    if (this.isLive) return super.tick(seconds, elapsed);
    const waits = this.countdown > 0;
    if (waits && this.playing) this.countdown -= elapsed;
    this.find("count").textContent = this.countdown > 0 ? Math.ceil(this.countdown) : "";
    if (!waits && !this.drag?.robot) {
      this.late += seconds;
      while (this.late >= DATA.dt && this.playing) {
        this.late -= DATA.dt;
        this.advance();
      }
    }
    this.draw(elapsed);
  }

  /** The state of a robot between two control steps. */
  between(robot) {
    const share = robot.ended ? 1 : this.late / DATA.dt;
    return robot.before.map((value, i) => value + share * (robot.x[i] - value));
  }

  draw(elapsed) {
    this.showNumbers();
    const push = this.shown && this.time < this.shown.until ? this.shown.impulse : null;
    const robots = this.everyone.map((robot) => {
      const pushable = robot !== this.best && !robot.ended;
      const label = `${robot.look.label} ${verdict(robot) || `${(robot.tilt * DEGREES).toFixed(0)}°`}`;
      const u = robot.ended ? null : robot.force;
      return { ...robot.look, label, x: this.between(robot), u, pushable, push: pushable ? push : null };
    });
    if (this.guide && !this.robots[0].over) robots[0].goal = this.guide.ahead(robots[0].x);
    const paths = this.everyone.map(({ path, look }, i) => ({ points: path, color: look.color, dashed: i > 0 }));
    // the camera does not follow a second robot that has ended, and only the driver's during a drive
    const watched = robots.slice(0, this.driver || this.robots[1].ended ? 1 : 2).map(({ x }) => x);
    this.show({ robots: robots.reverse(), paths: paths.reverse(), markers: this.scenario.markers, watched }, elapsed);
  }

  showNumbers() {
    const rows = this.everyone.map((robot) => {
      const force = robot.ended ? 0 : Math.hypot(...robot.force);
      const cells = [
        `${(robot.tilt * DEGREES).toFixed(0)}°`,
        `${(robot.peak * DEGREES).toFixed(0)}°`,
        `${force.toFixed(0)} N`,
        robot.cost.toFixed(1),
        robot === this.best ? `of ${this.scenario.optimum.toFixed(1)}` : robot.failed ? verdict(robot) : this.regret(robot),
      ];
      return { label: robot.look.label, color: robot.look.color, cells, mood: robot.failed ? "bad" : robot.over ? "good" : "" };
    });
    this.showRows(rows);
  }

  /** How much more than the optimum an undisturbed robot has cost so far, or in all once its episode is over.
   * During a drive, the driver's is that of the whole episode if the policy takes over now. If the policy fails from here on, it is
   * a lower bound, by the cost so far. It is never negative. */
  regret(robot) {
    if (!this.best || this.disturbed || robot.failed || !(this.best.cost > 0)) return "";
    if (this.driver && robot === this.robots[0] && !robot.over) {
      const { cost } = this.forecast;
      const least = Math.max(0, 100 * ((cost ?? robot.cost) / this.scenario.optimum - 1));
      return `${cost === null ? "at least" : "about"} ${least.toFixed(0)} %`;
    }
    const share = 100 * (robot.cost / (robot.over ? this.scenario.optimum : this.best.cost) - 1);
    // nothing costs less than the optimum over a whole episode
    return robot.over ? `regret ${Math.max(0, share).toFixed(1)} %` : `${share < 0 ? "−" : "+"}${Math.abs(share).toFixed(0)} % so far`;
  }

  /** During a drive, drags and keys hold the stick. */
  listen() {
    super.listen();
    const view = this.find("view");
    view.onkeyup = (event) => {
      if (this.held.delete(event.key)) this.steerByKeys();
    };
    view.onblur = () => {
      if (this.held.size) this.steerByKeys(this.held.clear());
    };
  }

  take(at) {
    super.take(at);
    if (!this.isDriven) return;
    this.drag.robot = null;
    this.showStick(at, [0, 0]);
  }

  pull(at) {
    if (!this.isDriven) return super.pull(at);
    const held = shortened(Vector.times(Vector.minus(at, this.drag.at), 1 / THUMB), 1);
    this.showStick(this.drag.at, held);
    this.steer(held[0], -held[1]);
  }

  letGo() {
    super.letGo();
    this.find("stick").hidden = true;
    if (this.isDriven) this.steer(0, 0);
  }

  press(key) {
    if (!this.isDriven || !ARROWS[key]) return super.press(key);
    this.held.add(key);
    this.steerByKeys();
    return true;
  }

  /** Whether drags and keys hold the stick. */
  get isDriven() {
    return !this.isLive && this.driver !== null;
  }

  showStick([x, y], [dx, dy]) {
    this.find("stick").hidden = false;
    this.find("stick").style.transform = `translate(${x}px, ${y}px)`;
    this.find("stick i").style.transform = `translate(${THUMB * dx}px, ${THUMB * dy}px)`;
  }

  /** Holds the driver's stick along the screen: x to the right, y away from the camera. */
  steer(x, y) {
    if (!this.isDriven) return;
    this.driver.hold(...this.onFloor(x, y));
    if (!this.playing && (x || y) && !this.robots[0].over) this.setPlaying(true);
  }

  steerByKeys() {
    const sum = [...this.held].map((key) => ARROWS[key]).reduce((total, along) => Vector.plus(total, along), [0, 0]);
    this.steer(...sum);
  }
}

const ENDS = { goal: "arrived", tilt: "fell", arena: "ran away", force: "gave no number" };

/** How a robot's episode ended, in a word; "" before it ends. */
const verdict = (robot) => ENDS[robot.ended] ?? (robot.failed ? "crashed" : "");

const playground = new Playground();
