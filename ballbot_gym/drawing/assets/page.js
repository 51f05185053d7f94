// The page around the scene: names above the robots, the table, and what pointers and keys do. It does not say where robots come
// from: playground.js computes them in the browser, and stream.js receives them from Python.
"use strict";

const STRONGEST = 250; // N·s
const BY_KEY = 90; // N·s, of a push
const NEAR = 3.6; // m: the camera's distance from robots that are together
const FAR_APART = 4; // m: robots at this distance are not shown together, and a camera jumps so far at once
const GRAB = 60; // px: how far from a robot's parts a drag still pushes it
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1], a: [-1, 0], d: [1, 0], w: [0, 1], s: [0, -1] };

/** A vector that is at most so long. */
const shortened = (vector, longest) => Vector.times(vector, Math.min(1, longest / Math.hypot(...vector)));

class Page extends Player {
  constructor() {
    super(document);
    this.scene = new Scene(this.find("view"), DATA);
    this.moment = { robots: [], paths: [], markers: [] };
    this.stream = null; // see stream.js
    this.isLive = false; // whether the page shows the stream
    this.find("reset").onclick = () => this.reset();
    this.listen();
  }

  /** A chip that opens something. */
  addChip(title, open) {
    const chip = document.createElement("button");
    Object.assign(chip, { type: "button", textContent: title, onclick: open });
    this.find("chips").append(chip);
  }

  /** Shows which chip is open, and what belongs to scenarios or to the stream alone. */
  setOpen(title, isLive) {
    this.isLive = isLive;
    this.find("count").textContent = "";
    this.find("stick").hidden = true;
    for (const chip of this.find("chips").children) chip.setAttribute("aria-pressed", chip.textContent === title);
    for (const part of document.querySelectorAll(".scenarios, .live")) part.hidden = part.classList.contains("live") !== isLive;
  }

  tick(seconds, elapsed) {
    if (this.stream?.moment) this.show(this.stream.moment, elapsed);
  }

  /** A moment, as `drawn` in page.py says. The camera keeps the points `watched` in view, the last robot unless they are given. */
  show(moment, elapsed) {
    this.moment = moment;
    if (moment.look) this.scene.look = moment.look;
    const { robots, paths, markers, watched } = moment;
    const pull = this.drag?.pull;
    const pulled = robots.map((robot) => (pull && robot.pushable ? { ...robot, push: pull } : robot));
    this.follow(watched ?? robots.slice(-1).map(({ x }) => x), elapsed);
    this.scene.draw({ robots: pulled, paths, markers });
    this.showNames([...robots].reverse());
  }

  /** Moves the camera towards the first point, or between it and the others that are not too far away. */
  follow([own, ...others], elapsed) {
    if (!own) return;
    const { camera } = this.scene;
    const distance = (x) => Math.hypot(own[0] - x[0], own[1] - x[1]);
    const [other] = others.filter((x) => distance(x) <= FAR_APART);
    const wanted = [0, 1].map((i) => own[i] + (other ? 0.5 * (other[i] - own[i]) : 0));
    const isJump = Math.hypot(camera.target[0] - wanted[0], camera.target[1] - wanted[1]) > FAR_APART;
    const blend = isJump ? 1 : 1 - Math.exp(-4 * elapsed);
    camera.target = camera.target.map((value, i) => value + blend * ([...wanted, 0.5][i] - value));
    camera.distance += blend * (NEAR + (other ? 0.9 * distance(other) : 0) - camera.distance);
  }

  /** Makes as many children of a node as there are things, and sets each by its thing. */
  fit(node, tag, things, set) {
    while (node.children.length > things.length) node.lastChild.remove();
    while (node.children.length < things.length) node.append(document.createElement(tag));
    things.forEach((thing, i) => set(node.children[i], thing));
  }

  showNames(robots) {
    const { look, canvas } = this.scene;
    const places = robots.map(({ x, label }) => label && this.scene.project(Vector.plus(pose(look.robot, x).top, [0, 0, 0.1])));
    places.forEach((place, i) => {
      const near = (other) => place && other && Math.abs(other[1] - place[1]) < 24 && Math.abs(other[0] - place[0]) < 110;
      for (let clash; (clash = places.slice(0, i).find(near)); ) place[1] = clash[1] - 24;
    });
    const named = robots.map((robot, i) => ({ ...robot, place: places[i] }));
    this.fit(this.find("names"), "div", named, (name, { label, color, place }) => {
      name.hidden = !place;
      if (name.hidden) return;
      name.textContent = label;
      name.style.setProperty("--robot", color);
      const half = name.offsetWidth / 2;
      const x = Math.min(Math.max(place[0], half), canvas.clientWidth - half);
      const y = Math.min(Math.max(place[1], 26), canvas.clientHeight - 10);
      name.style.transform = `translate(${x}px, ${y}px) translate(-50%, -100%)`;
    });
  }

  /** The table: rows {label, color, cells, mood}, with a mood of "good", "bad" or "". */
  showRows(rows) {
    this.find("readouts").hidden = rows.length === 0;
    this.fit(this.find("readouts tbody"), "tr", rows, (row, { label, color, cells, mood }) => {
      row.style.setProperty("--robot", color);
      this.fit(row, "td", [label, ...cells], (cell, text) => (cell.textContent = text));
      row.lastChild.className = mood;
    });
  }

  /** What is along the screen, x to the right and y away from the camera, along the floor. */
  onFloor(x, y) {
    const { right, back } = this.scene;
    return Vector.plus(Vector.times(right.slice(0, 2), x), back.slice(0, 2), -y / Math.hypot(back[0], back[1]));
  }

  /** Pointers and keys. */
  listen() {
    const view = this.find("view");
    const place = (event) => [event.offsetX, event.offsetY];
    view.onpointerdown = (event) => {
      view.setPointerCapture(event.pointerId);
      this.take(place(event));
    };
    view.onpointermove = (event) => this.drag && this.pull(place(event));
    view.onpointerup = () => {
      const pull = this.drag?.pull;
      this.letGo();
      if (pull) this.hit(pull);
    };
    view.onpointercancel = () => this.letGo();
    view.onkeydown = (event) => {
      if (!(event.ctrlKey || event.altKey || event.metaKey) && this.press(event.key)) event.preventDefault();
    };
  }

  /** A drag that begins at a robot pushes it, and any other turns the camera. */
  take(at) {
    this.drag = { at, robot: this.robotAt(at), pull: null };
  }

  pull(at) {
    if (this.drag.robot) this.drag.pull = this.pullTo(at);
    else {
      this.scene.turn(...Vector.minus(at, this.drag.at));
      this.drag.at = at;
    }
  }

  letGo() {
    this.drag = null;
  }

  /** Does what a key asks for; returns whether that is anything. */
  press(key) {
    if (ARROWS[key] && key.length > 1) this.hit(Vector.times(this.onFloor(...ARROWS[key]), BY_KEY));
    else if (key === " ") this.setPlaying(!this.playing);
    else if (key === "r") this.reset();
    else return this.isLive && this.stream.press(key);
    return true;
  }

  /** The robot near a pixel of the canvas that can be pushed, the last one first, or undefined. */
  robotAt(pixel) {
    const isNear = (place) => place && Math.hypot(...Vector.minus(pixel, place)) < GRAB;
    const isHere = ({ x }) => {
      const { ball, low, body, top } = pose(this.scene.look.robot, x);
      return [ball, low, body, top].some((part) => isNear(this.scene.project(part)));
    };
    return [...this.moment.robots].reverse().find((robot) => robot.pushable && isHere(robot));
  }

  /** The impulse of a drag from the robot's centre of mass to a pixel, N·s; null where it is too short. */
  pullTo(pixel) {
    const { robot, push_scale } = this.scene.look;
    const [, , height] = pose(robot, this.drag.robot.x).body;
    const from = (this.drag.from ??= this.scene.unproject(this.drag.at, height));
    const to = this.scene.unproject(pixel, height);
    if (!from || !to) return this.drag.pull;
    const impulse = shortened(Vector.times(Vector.minus(to, from).slice(0, 2), 1 / push_scale), STRONGEST);
    return Math.hypot(...impulse) < 3 ? null : impulse;
  }

  // What the stream does where the page shows it, and playground.js where it shows a scenario.

  setPlaying(playing) {
    if (this.isLive) this.stream.ask("playing", playing);
    else super.setPlaying(playing);
  }

  reset() {
    if (this.isLive) this.stream.ask("Restart", true);
  }

  hit(impulse) {
    if (this.isLive) this.stream.ask("push", impulse);
  }
}
