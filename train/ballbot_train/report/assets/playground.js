// The playground's page: scenarios, pushes by button, key and drag, pictures and readouts.
"use strict";

const find = (selector) => document.querySelector(selector);
const DEGREES = 180 / Math.PI;
const SHOWN_SECONDS = 6; // of the tilts
const PUSH_SHOWN = 0.5; // s of the episode, for which a push's arrow stays
const METRES_PER_IMPULSE = 1 / 130; // of a push's arrow, m per N·s
const STRONGEST = 250; // N·s
const NEAR = 3.6; // m: the camera's distance from robots that are together
const GRAB = 60; // px: how far from a robot's axis a drag still pushes it

class Playground {
  constructor() {
    try {
      this.scene = new Scene(find(".view"), DATA.robot, DATA);
    } catch (error) {
      find(".trouble").hidden = false;
      find(".trouble").textContent = `The robots cannot be drawn: ${error.message}. The numbers below are computed all the same.`;
    }
    [this.playing, this.last] = [true, null];
    [this.distance, this.zoom] = [NEAR, 1];
    this.wake();
    DATA.scenarios.forEach((scenario, i) => {
      const chip = document.createElement("button");
      chip.type = "button";
      chip.textContent = scenario.title;
      chip.onclick = () => this.open(i);
      find(".chips").append(chip);
    });
    find(".play").onclick = () => this.setPlaying(!this.playing);
    find(".reset").onclick = () => this.open(this.index);
    find(".impulse").oninput = () => (find(".strength output").textContent = `${this.impulse} N·s`);
    for (const button of document.querySelectorAll(".pushes button")) {
      button.onclick = () => this.pushOnScreen(Number(button.dataset.x), Number(button.dataset.y));
    }
    this.listen();
    this.open(0);
    requestAnimationFrame((now) => this.tick(now));
  }

  get impulse() {
    return Number(find(".impulse").value);
  }

  open(index) {
    this.index = index;
    this.scenario = DATA.scenarios[index];
    [...find(".chips").children].forEach((chip, i) => chip.setAttribute("aria-pressed", i === index));
    find(".text").textContent = this.scenario.text;
    this.robots = robotsOf(this.scenario);
    const { label, color } = DATA.policies[this.scenario.task];
    this.looks = [{ label: `${label} policy`, color, alpha: 1 }, { ...DATA.lqr, alpha: DATA.ghost_opacity + 0.15 }];
    this.due = this.scenario.push; // the push that comes by itself
    this.restart(this.scenario.state);
    find(".readouts tbody").replaceChildren(
      ...this.looks.map((look) => {
        const row = document.createElement("tr");
        for (let i = 0; i < 6; i++) row.append(document.createElement("td"));
        row.cells[0].textContent = look.label;
        row.cells[0].style.color = look.color;
        return row;
      }),
      ...(this.scenario.optimum ? [this.optimumRow()] : []),
    );
    find(".names").replaceChildren(
      ...this.looks.map((look) => {
        const name = document.createElement("div");
        name.style.color = look.color;
        return name;
      }),
    );
    if (this.scene) {
      const [x, y] = this.scenario.state;
      this.scene.camera.target = [x, y, 0.5];
    }
    this.setPlaying(true);
  }

  optimumRow() {
    const row = document.createElement("tr");
    for (let i = 0; i < 6; i++) row.append(document.createElement("td"));
    row.cells[0].textContent = "best possible";
    row.cells[4].textContent = this.scenario.optimum.toFixed(1);
    row.cells[5].textContent = `in ${this.scenario.duration} s`;
    return row;
  }

  /** All robots in one state, at time 0. */
  restart(state) {
    this.wake();
    for (const robot of this.robots) robot.reset(state);
    this.disturbed = false; // a regret is that of an episode that nobody disturbs
    this.time = 0;
    this.late = 0; // s of the episode that are not computed yet
    this.shown = null; // the push whose arrow is shown: {impulse, until}
    this.tilts = this.robots.map(() => []);
  }

  /** Draws for a while even if time stands still: what is shown has changed, and the camera comes after it. */
  wake() {
    this.awake = performance.now() + 1500;
  }

  setPlaying(playing) {
    this.wake();
    this.playing = playing;
    this.last = null;
    find(".play").textContent = playing ? "Pause" : "Play";
  }

  /** One control step of all robots. */
  advance() {
    if (this.due && this.time >= this.due[0] - 1e-9) {
      const [, impulse, bearing] = this.due;
      this.due = null;
      this.hit([impulse * Math.cos(bearing), impulse * Math.sin(bearing)]);
    }
    this.robots.forEach((robot, i) => {
      robot.advance();
      this.tilts[i].push([this.time, robot.tilt * DEGREES]);
      if (this.tilts[i].length > SHOWN_SECONDS / DATA.dt) this.tilts[i].shift();
    });
    this.time += DATA.dt;
  }

  /** A push for everyone. Where somebody has fallen, all start again first. */
  hit(impulse) {
    const size = Math.hypot(...impulse);
    if (!(size > 0)) return;
    const bounded = impulse.map((part) => (part * Math.min(size, STRONGEST)) / size);
    if (this.robots.some((robot) => robot.ended)) this.restart(this.scenario.state);
    this.due = null;
    this.disturbed = true;
    for (const robot of this.robots) robot.hit(bounded);
    this.shown = { impulse: bounded, until: this.time + PUSH_SHOWN };
    if (!this.playing) this.setPlaying(true);
  }

  /** A push along the screen: x to the right, y away from the camera. */
  pushOnScreen(x, y) {
    const [right, back] = this.scene?.right ? [this.scene.right, this.scene.back] : [[1, 0], [0, -1]];
    const away = Math.hypot(back[0], back[1]);
    this.hit([0, 1].map((i) => this.impulse * (x * right[i] - (y * back[i]) / away)));
  }

  tick(now) {
    if (this.last !== null && this.playing && !this.drag?.robot) {
      this.late += Math.min((now - this.last) / 1000, 0.1) * Number(find(".speed").value);
      while (this.late >= DATA.dt) {
        this.late -= DATA.dt;
        this.advance();
      }
    }
    const elapsed = this.last === null ? 0 : Math.min((now - this.last) / 1000, 0.1);
    this.last = now;
    if (this.playing || this.drag || now < this.awake) this.draw(elapsed);
    requestAnimationFrame((next) => this.tick(next));
  }

  /** The state of a robot between two control steps. */
  between(robot) {
    const share = robot.ended ? 1 : this.late / DATA.dt;
    return robot.before.map((value, i) => value + share * (robot.x[i] - value));
  }

  draw(elapsed) {
    const states = this.robots.map((robot) => this.between(robot));
    this.showNumbers();
    this.drawTilts();
    if (!this.scene) return;
    this.follow(states, elapsed);
    const pull = this.drag?.pull ?? (this.shown && this.time < this.shown.until ? this.shown.impulse : null);
    const robots = states.map((x, i) => ({
      x,
      color: this.looks[i].color,
      alpha: this.looks[i].alpha,
      u: this.robots[i].ended ? null : this.robots[i].force,
      push: pull && !this.robots[i].ended ? pull.map((part) => part * METRES_PER_IMPULSE) : null,
    }));
    const paths = this.robots.map((robot, i) => ({ points: robot.path, color: this.looks[i].color, dashed: i > 0 }));
    this.scene.draw({ robots: [...robots].reverse(), paths: paths.reverse(), markers: this.scenario.markers });
    this.showNames(states);
  }

  /** The camera follows the policy's robot, and for a while the one that falls. */
  follow(states, elapsed) {
    const camera = this.scene.camera;
    const [own, other] = states;
    const apart = Math.hypot(own[0] - other[0], own[1] - other[1]);
    const share = apart > 4 || this.robots[1].ended ? 0 : 0.5; // who is far behind or has ended is left there
    const wanted = [own[0] + share * (other[0] - own[0]), own[1] + share * (other[1] - own[1]), 0.5];
    const blend = 1 - Math.exp(-4 * elapsed);
    camera.target = camera.target.map((value, i) => value + blend * (wanted[i] - value));
    this.distance += blend * (NEAR + (apart > 4 ? 0 : 0.9 * apart) - this.distance);
    camera.distance = this.distance * this.zoom;
  }

  showNames(states) {
    const height = DATA.robot.ball_radius + DATA.robot.com_height + DATA.robot.body_length / 2 + 0.1;
    const places = states.map((x) => this.scene.project(Vector.plus([x[0], x[1], 0], bodyFrame(x)[2], height)));
    if (places[0] && places[1] && Math.abs(places[0][1] - places[1][1]) < 24 && Math.abs(places[0][0] - places[1][0]) < 110) {
      places[1][1] = Math.min(places[0][1], places[1][1]) - 12;
      places[0][1] = places[1][1] + 24;
    }
    [...find(".names").children].forEach((name, i) => {
      name.hidden = !places[i];
      if (!places[i]) return;
      const robot = this.robots[i];
      name.textContent = `${this.looks[i].label} ${verdict(robot) || `${(robot.tilt * DEGREES).toFixed(0)}°`}`;
      const x = Math.min(Math.max(places[i][0], 50), this.scene.canvas.clientWidth - 50);
      const y = Math.min(Math.max(places[i][1], 26), this.scene.canvas.clientHeight - 10);
      name.style.transform = `translate(${x}px, ${y}px) translate(-50%, -100%)`;
    });
  }

  showNumbers() {
    const rows = find(".readouts tbody").rows;
    this.robots.forEach((robot, i) => {
      const force = robot.ended ? 0 : Math.hypot(...robot.force);
      const cells = [
        `${(robot.tilt * DEGREES).toFixed(0)}°`,
        `${(robot.peak * DEGREES).toFixed(0)}°`,
        `${force.toFixed(0)} N`,
        robot.cost.toFixed(1),
        verdict(robot) === "arrived" ? this.regret(robot) : verdict(robot) || this.regret(robot),
      ];
      cells.forEach((text, k) => (rows[i].cells[k + 1].textContent = text));
      rows[i].cells[5].style.color = robot.failed ? "#c01818" : "#1a7f4b";
    });
  }

  /** How much more than the best possible an undisturbed episode has cost, once it is over; "" before. */
  regret(robot) {
    const { optimum, duration } = this.scenario;
    if (optimum === null || this.disturbed || robot.failed) return "";
    if (robot.ended !== "goal" && robot.steps * DATA.dt < duration - 1e-9) return "";
    return `regret ${Math.max(0, 100 * (robot.cost / optimum - 1)).toFixed(1)} %`;
  }

  drawTilts() {
    const canvas = find(".tilts");
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio)) [canvas.width, canvas.height] = [width * ratio, height * ratio].map(Math.round);
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const start = Math.max(0, this.time - SHOWN_SECONDS);
    const across = (t) => 26 + ((t - start) / SHOWN_SECONDS) * (width - 30);
    const up = (tilt) => height - 6 - (tilt / 90) * (height - 14);
    pen.font = "11px system-ui, sans-serif";
    pen.textBaseline = "middle";
    for (const tilt of [0, 30, 60, 90]) {
      pen.fillStyle = "#667085";
      pen.fillText(String(tilt), 4, up(tilt));
      pen.fillStyle = "#e4e7ec";
      pen.fillRect(26, up(tilt), width - 30, 1);
    }
    this.tilts.forEach((line, i) => {
      pen.strokeStyle = this.looks[i].color;
      pen.lineWidth = 2;
      pen.beginPath();
      line.forEach(([t, tilt], k) => (k ? pen.lineTo(across(t), up(tilt)) : pen.moveTo(across(t), up(tilt))));
      pen.stroke();
    });
  }

  /** Pointers and keys. A drag that begins at a robot pushes, any other turns the camera; time stands still while one pulls. */
  listen() {
    const view = find(".view");
    const place = (event) => [event.offsetX, event.offsetY];
    window.addEventListener("resize", () => this.wake());
    view.onpointerdown = (event) => {
      if (!this.scene) return;
      const robot = this.robotAt(place(event));
      this.drag = { at: place(event), robot, pull: null };
      view.setPointerCapture(event.pointerId);
      find(".hint").hidden = true;
    };
    view.onpointermove = (event) => {
      if (!this.scene?.matrix) return;
      if (!this.drag) {
        view.classList.toggle("over", this.robotAt(place(event)) !== null);
        return;
      }
      const [x, y] = place(event);
      if (this.drag.robot) this.drag.pull = this.pullTo([x, y]);
      else {
        const camera = this.scene.camera;
        camera.yaw -= (x - this.drag.at[0]) * 0.008;
        camera.pitch = Math.min(Math.max(camera.pitch + (y - this.drag.at[1]) * 0.006, 0.05), 1.45);
        this.drag.at = [x, y];
      }
    };
    view.onpointerup = () => {
      this.wake();
      const pull = this.drag?.pull;
      this.drag = null;
      if (pull) this.hit(pull);
    };
    view.onpointercancel = () => (this.drag = null);
    view.addEventListener(
      "wheel",
      (event) => {
        if (!this.scene || !event.ctrlKey) return; // the wheel alone scrolls the page around the playground; pinches hold ctrl
        event.preventDefault();
        this.wake();
        this.zoom = Math.min(Math.max(this.zoom * Math.exp(event.deltaY * 0.001), 0.4), 4);
      },
      { passive: false },
    );
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    view.onkeydown = (event) => {
      if (arrows[event.key]) this.pushOnScreen(...arrows[event.key]);
      else if (event.key === " ") this.setPlaying(!this.playing);
      else return;
      event.preventDefault();
    };
  }

  /** The robot near a pixel of the canvas, or null. */
  robotAt([px, py]) {
    for (const robot of this.robots) {
      if (robot.ended) continue;
      const x = this.between(robot);
      const axis = bodyFrame(x)[2];
      const ball = [x[0], x[1], DATA.robot.ball_radius];
      const [low, high] = [ball, Vector.plus(ball, axis, DATA.robot.com_height + DATA.robot.body_length / 2)].map((p) => this.scene.project(p));
      if (!low || !high) continue;
      const along = Vector.minus(high, low);
      const share = Math.min(Math.max(Vector.dot(Vector.minus([px, py], low), along) / Vector.dot(along, along), 0), 1);
      const nearest = Vector.plus(low, along, share);
      if (Math.hypot(px - nearest[0], py - nearest[1]) < GRAB) return robot;
    }
    return null;
  }

  /** The impulse of a drag from the robot's centre of mass to a pixel, N·s; null where it is too short. */
  pullTo(pixel) {
    const x = this.between(this.drag.robot);
    const centre = Vector.plus([x[0], x[1], DATA.robot.ball_radius], bodyFrame(x)[2], DATA.robot.com_height);
    const from = this.drag.from ?? (this.drag.from = this.scene.unproject(this.drag.at, centre[2]));
    const to = this.scene.unproject(pixel, centre[2]);
    if (!from || !to) return this.drag.pull;
    const impulse = [0, 1].map((i) => (to[i] - from[i]) / METRES_PER_IMPULSE);
    const size = Math.hypot(...impulse);
    if (size < 3) return null;
    const bounded = Math.min(size, STRONGEST);
    find(".strength output").textContent = `${bounded.toFixed(0)} N·s`;
    return impulse.map((part) => (part * bounded) / size);
  }
}

/** How a robot's episode ended, in a word; "" while it goes on. */
function verdict(robot) {
  if (robot.ended === "goal") return "arrived";
  if (robot.ended === "tilt") return "fell";
  if (robot.ended === "arena") return "ran away";
  return robot.ended ? "touched" : "";
}

const playground = new Playground();
