// The playground's page: scenarios, pushes and driving, pictures and readouts.
"use strict";

const DEGREES = 180 / Math.PI;
const PUSH_SHOWN = 0.5; // s of the episode, for which a push's arrow stays
const STRONGEST = 250; // N·s
const BY_KEY = 90; // N·s, of a push
const NEAR = 3.6; // m: the camera's distance from robots that are together
const GRAB = 60; // px: how far from a robot's parts a drag still pushes it
const COUNTDOWN = 3; // s, before a drive begins
const THUMB = 70; // px of a drag that holds the stick fully out
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1], a: [-1, 0], d: [1, 0], w: [0, 1], s: [0, -1] };

class Playground extends Player {
  constructor() {
    super(document);
    this.scene = new Scene(this.find("view"), DATA);
    for (const chip of this.find("chips").children) {
      chip.onclick = () => this.open(DATA.scenarios.findIndex(({ title }) => title === chip.textContent));
    }
    this.find("reset").onclick = () => this.open(this.index, this.driver !== null, this.given);
    this.find("episode").onchange = (event) => this.open(Number(event.target.value), this.driver !== null);
    this.find("drive").onclick = () => this.open(this.index, this.driver === null || this.given !== null);
    this.sliders = [...this.find("unknown").querySelectorAll("input")];
    for (const slider of this.sliders) slider.oninput = () => this.setRobot();
    this.find("told").onclick = () => this.setRobot(KNOWN);
    this.find("drawn").onclick = () => this.setRobot(this.sliders.map(({ min, max }) => (+min + Math.random() * (max - min)) / 100));
    this.listen();
    this.setRobot(KNOWN, 0);
    this.openLinked();
    window.onhashchange = () => this.openLinked();
  }

  /** Replays the drive of a link; an address that tells of none changes nothing. */
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

  /** The robot's factors, from the sliders unless they are given, and the scenario anew. */
  setRobot(factors = null, index = this.index) {
    this.sliders.forEach((slider, i) => {
      if (factors) slider.value = Math.round(100 * factors[i]);
      slider.nextElementSibling.textContent = `${slider.value} %`;
    });
    this.robot = this.sliders.map((slider) => Number(slider.value) / 100);
    this.isKnown = this.robot.every((factor) => factor === 1);
    this.find("told").disabled = this.isKnown;
    this.open(index, Boolean(this.driver));
  }

  /** Opens a scenario; where somebody drives, in an episode whose optimum is known. The drive may be given, as of a link. */
  open(index, driven = false, given = null) {
    if (driven && DATA.scenarios[index].optimum === null) index = DATA.scenarios.findIndex((scenario) => scenario.optimum !== null);
    this.index = index;
    this.scenario = DATA.scenarios[index];
    const { title, task } = this.scenario;
    for (const chip of this.find("chips").children) chip.setAttribute("aria-pressed", chip.textContent === title);
    const same = [...DATA.scenarios.entries()].filter(([, scenario]) => scenario.title === title);
    this.find("episode").replaceChildren(...same.map(([i, { episode }]) => new Option(episode ?? "at rest", i, false, i === index)));
    this.find("text").textContent = given
      ? "A drive is replayed. Drive it yourself, and do better."
      : driven
      ? "You drive against the optimum: the stick is the robot's lean. Arrow keys or W A S D, or drag in the picture."
      : `${this.scenario.text} Drag a robot to push it, or the floor to look around.`;
    this.find("drive").setAttribute("aria-pressed", driven && !given);
    this.given = given;
    this.driver = given ? new Replayed(given) : driven ? new Driver() : null;
    this.countdown = driven && !given ? COUNTDOWN : 0;
    this.held = new Set(); // keys
    this.robots = robotsOf(this.scenario, this.driver, this.robot);
    // the page has the optima of the robot that everybody knows, and a regret over them would be one over something else
    this.best = this.isKnown && this.scenario.best && new Optimum(this.scenario);
    const { label, color } = DATA.policies[task];
    const learned = { label: `${label} policy`, color, alpha: 1 };
    const ghost = DATA.ghost_opacity + 0.15;
    const driver = { ...DATA.you, alpha: 1, label: given ? "driver" : DATA.you.label };
    const looks = driven ? [driver, { ...learned, alpha: ghost }] : [learned, { ...DATA.lqr, alpha: ghost }];
    this.everyone = this.best ? [...this.robots, this.best] : this.robots;
    this.everyone.forEach((robot, i) => (robot.look = looks[i] ?? { ...DATA.best, alpha: DATA.ghost_opacity }));
    this.due = this.scenario.push; // the push that comes by itself
    this.restart(this.scenario.state);
    [...this.find("readouts tbody").rows].forEach((row, i) => {
      row.hidden = i >= this.everyone.length;
      if (row.hidden) return;
      const { label, color } = this.everyone[i].look;
      row.cells[0].textContent = label;
      for (const shown of [row, this.find("names").children[i]]) shown.style.setProperty("--robot", color);
    });
    const [x, y] = this.scenario.state;
    this.scene.camera.target = [x, y, 0.5];
    this.setPlaying(true);
    if (driven && !given) this.find("view").focus({ preventScroll: true }); // the keys are for the robot from now on
  }

  /** All robots in one state, at time 0. */
  restart(state) {
    for (const robot of this.everyone) robot.reset(state);
    this.disturbed = false; // a regret is that of an episode that nobody disturbs
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

  /** A push for everyone. Where somebody has fallen, all start again first. */
  hit(impulse) {
    if (!(Math.hypot(...impulse) > 0)) return;
    const bounded = shortened(impulse, STRONGEST);
    if (this.robots.some((robot) => robot.ended)) this.restart(this.scenario.state);
    this.due = null;
    this.disturbed = true;
    for (const robot of this.robots) robot.hit(bounded);
    this.shown = { impulse: bounded, until: this.time + PUSH_SHOWN };
    if (!this.playing) this.setPlaying(true);
  }

  /** What is along the screen, x to the right and y away from the camera, along the floor. */
  onFloor(x, y) {
    const { right, back } = this.scene;
    return Vector.plus(Vector.times(right.slice(0, 2), x), back.slice(0, 2), -y / Math.hypot(back[0], back[1]));
  }

  tick(seconds, elapsed) {
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
    const states = this.everyone.map((robot) => this.between(robot));
    this.showNumbers();
    this.follow(states, elapsed);
    const pull = this.drag?.pull ?? (this.shown && this.time < this.shown.until ? this.shown.impulse : null);
    const robots = this.everyone.map((robot, i) => ({
      x: states[i],
      color: robot.look.color,
      alpha: robot.look.alpha,
      u: robot.ended ? null : robot.force,
      push: pull && robot !== this.best && !robot.ended ? Vector.times(pull, DATA.push_scale) : null,
    }));
    const paths = this.everyone.map(({ path, look }, i) => ({ points: path, color: look.color, dashed: i > 0 }));
    this.scene.draw({ robots: robots.reverse(), paths: paths.reverse(), markers: this.scenario.markers });
    this.showNames(states);
  }

  /** The camera follows the first robot, and for a while the one that falls. */
  follow(states, elapsed) {
    const camera = this.scene.camera;
    const [own, other] = states;
    const apart = Math.hypot(own[0] - other[0], own[1] - other[1]);
    const share = this.driver || apart > 4 || this.robots[1].ended ? 0 : 0.5; // who is far behind or has ended is left there
    const wanted = [own[0] + share * (other[0] - own[0]), own[1] + share * (other[1] - own[1]), 0.5];
    const blend = 1 - Math.exp(-4 * elapsed);
    camera.target = camera.target.map((value, i) => value + blend * (wanted[i] - value));
    camera.distance += blend * (NEAR + (apart > 4 ? 0 : 0.9 * apart) - camera.distance);
  }

  showNames(states) {
    const places = states.map((x) => this.scene.project(Vector.plus(pose(DATA.robot, x).top, [0, 0, 0.1])));
    places.forEach((place, i) => {
      const near = (other) => place && other && Math.abs(other[1] - place[1]) < 24 && Math.abs(other[0] - place[0]) < 110;
      for (let clash; (clash = places.slice(0, i).find(near)); ) place[1] = clash[1] - 24;
    });
    [...this.find("names").children].forEach((name, i) => {
      name.hidden = !places[i]; // of robots that there are not, too
      if (name.hidden) return;
      const robot = this.everyone[i];
      name.textContent = `${robot.look.label} ${verdict(robot) || `${(robot.tilt * DEGREES).toFixed(0)}°`}`;
      const half = name.offsetWidth / 2;
      const x = Math.min(Math.max(places[i][0], half), this.scene.canvas.clientWidth - half);
      const y = Math.min(Math.max(places[i][1], 26), this.scene.canvas.clientHeight - 10);
      name.style.transform = `translate(${x}px, ${y}px) translate(-50%, -100%)`;
    });
  }

  showNumbers() {
    const rows = this.find("readouts tbody").rows;
    this.everyone.forEach((robot, i) => {
      const force = robot.ended ? 0 : Math.hypot(...robot.force);
      const cells = [
        `${(robot.tilt * DEGREES).toFixed(0)}°`,
        `${(robot.peak * DEGREES).toFixed(0)}°`,
        `${force.toFixed(0)} N`,
        robot.cost.toFixed(1),
        robot === this.best ? `of ${this.scenario.optimum.toFixed(1)}` : robot.failed ? verdict(robot) : this.regret(robot),
      ];
      cells.forEach((text, k) => (rows[i].cells[k + 1].textContent = text));
      rows[i].cells[5].className = robot.failed ? "bad" : robot.over ? "good" : "";
    });
  }

  /** How much more than the optimum an undisturbed robot has cost so far, or in all once its episode is over.
   * Who drives is told the least regret that is still possible: what it has cost already, over the whole optimum. */
  regret(robot) {
    if (!this.best || this.disturbed || robot.failed || !(this.best.cost > 0)) return "";
    if (this.driver && !robot.over) return `at least ${Math.max(0, 100 * (robot.cost / this.scenario.optimum - 1)).toFixed(0)} %`;
    const share = 100 * (robot.cost / (robot.over ? this.scenario.optimum : this.best.cost) - 1);
    // nothing costs less than the optimum over a whole episode
    return robot.over ? `regret ${Math.max(0, share).toFixed(1)} %` : `${share < 0 ? "−" : "+"}${Math.abs(share).toFixed(0)} % so far`;
  }

  /** Pointers and keys. A drag that begins at a robot pushes, any other turns the camera; time stands still while one pulls. */
  listen() {
    const view = this.find("view");
    const place = (event) => [event.offsetX, event.offsetY];
    view.onpointerdown = (event) => {
      const robot = this.driver ? null : this.robotAt(place(event));
      this.drag = { at: place(event), robot, pull: null };
      view.setPointerCapture(event.pointerId);
      if (this.driver) this.showStick(this.drag.at, [0, 0]);
    };
    view.onpointermove = (event) => {
      if (!this.drag) return;
      const [x, y] = place(event);
      if (this.driver) {
        const held = shortened(Vector.times(Vector.minus([x, y], this.drag.at), 1 / THUMB), 1);
        this.showStick(this.drag.at, held);
        this.steer(held[0], -held[1]);
      } else if (this.drag.robot) this.drag.pull = this.pullTo([x, y]);
      else {
        this.scene.turn(...Vector.minus([x, y], this.drag.at));
        this.drag.at = [x, y];
      }
    };
    view.onpointerup = () => {
      const pull = this.drag?.pull;
      this.letGo();
      if (pull) this.hit(pull);
    };
    view.onpointercancel = () => this.letGo();
    view.onkeydown = (event) => {
      const along = event.ctrlKey || event.altKey || event.metaKey ? null : ARROWS[event.key];
      if (along && this.driver) {
        this.held.add(event.key);
        this.steerByKeys();
      } else if (along && event.key.length > 1) this.hit(Vector.times(this.onFloor(...along), BY_KEY));
      else if (event.key === " ") this.setPlaying(!this.playing);
      else return;
      event.preventDefault();
    };
    view.onkeyup = (event) => {
      if (this.held.delete(event.key)) this.steerByKeys();
    };
    view.onblur = () => {
      if (this.held.size) this.steerByKeys(this.held.clear());
    };
  }

  letGo() {
    this.drag = null;
    this.find("stick").hidden = true;
    if (this.driver) this.steer(0, 0);
  }

  showStick([x, y], [dx, dy]) {
    this.find("stick").hidden = false;
    this.find("stick").style.transform = `translate(${x}px, ${y}px)`;
    this.find("stick i").style.transform = `translate(${THUMB * dx}px, ${THUMB * dy}px)`;
  }

  /** Holds the driver's stick along the screen: x to the right, y away from the camera. */
  steer(x, y) {
    if (!this.driver) return;
    this.driver.hold(...this.onFloor(x, y));
    if (!this.playing && (x || y) && !this.robots[0].over) this.setPlaying(true);
  }

  steerByKeys() {
    const sum = [...this.held].map((key) => ARROWS[key]).reduce((total, along) => Vector.plus(total, along), [0, 0]);
    this.steer(...sum);
  }

  /** The robot near a pixel of the canvas, or null. */
  robotAt(pixel) {
    const isNear = (place) => place && Math.hypot(...Vector.minus(pixel, place)) < GRAB;
    const isHere = (robot) => {
      const { ball, low, body, top } = pose(DATA.robot, this.between(robot));
      return [ball, low, body, top].some((part) => isNear(this.scene.project(part)));
    };
    return this.robots.find((robot) => !robot.ended && isHere(robot)) ?? null;
  }

  /** The impulse of a drag from the robot's centre of mass to a pixel, N·s; null where it is too short. */
  pullTo(pixel) {
    const [, , height] = pose(DATA.robot, this.between(this.drag.robot)).body;
    const from = (this.drag.from ??= this.scene.unproject(this.drag.at, height));
    const to = this.scene.unproject(pixel, height);
    if (!from || !to) return this.drag.pull;
    const impulse = shortened(Vector.times(Vector.minus(to, from).slice(0, 2), 1 / DATA.push_scale), STRONGEST);
    return Math.hypot(...impulse) < 3 ? null : impulse;
  }
}

/** A vector that is at most so long. */
const shortened = (vector, longest) => Vector.times(vector, Math.min(1, longest / Math.hypot(...vector)));

const ENDS = { goal: "arrived", tilt: "fell", arena: "ran away", force: "gave no number" };

/** How a robot's episode ended, in a word; "" while it goes on. */
const verdict = (robot) => ENDS[robot.ended] ?? (robot.failed ? "touched" : "");

const playground = new Playground();
