// The playground's mathematics, without a page: robots that a policy or LQR controls. `step`, `push`, `MODELS` and `DATA`
// come before it, printed by playground.py. The same code runs in the browser and, in tests, in node.
"use strict";

/** Numbers that Python packed, as an array. */
function unpacked({ float32, float64 }) {
  const bytes = Uint8Array.from(atob(float32 ?? float64), (letter) => letter.charCodeAt(0));
  return float32 === undefined ? new Float64Array(bytes.buffer) : new Float32Array(bytes.buffer);
}

const ACTIVATIONS = { tanh: Math.tanh, relu: (a) => Math.max(a, 0), silu: (a) => a / (1 + Math.exp(-a)) };

/** A learned policy. What it computes around its networks is printed: `action` of `MODELS`. */
class Policy {
  constructor(data, model) {
    this.model = model;
    const [mlp, linear, routes] = [data.mlp, data.linear, data.routes].map((layers) =>
      layers.map(([weight, bias]) => ({ weight: unpacked(weight), bias: bias && unpacked(bias) })),
    );
    const sum = (inputs) => {
      const values = network(mlp, ACTIVATIONS[data.activation], inputs);
      return linear.length ? affine(linear[0], inputs).map((value, i) => value + values[i]) : values;
    };
    this.networks = [sum, (layout) => farther(network(routes, Math.tanh, layout))];
  }

  act(k, x, c) {
    const action = this.model.action(Float32Array.from(this.model.observe(x, c)), this.networks);
    return action.map((a) => DATA.force_limit * Math.fround(a));
  }
}

/** For every obstacle, whether it is passed on its nearer side, 1, or on its farther, −1, of outputs that belong to the choices. */
function farther(outputs) {
  const best = outputs.indexOf(Math.max(...outputs));
  const obstacles = Math.log2(outputs.length);
  return Array.from({ length: obstacles }, (_, i) => ((best >> (obstacles - 1 - i)) & 1 ? -1 : 1));
}

/** Layers with an activation between them. */
function network(layers, activate, inputs) {
  return layers.reduce((values, layer, i) => affine(layer, i === 0 ? values : values.map(activate)), inputs);
}

/** W v + b, with W in rows. */
function affine({ weight, bias }, values) {
  const outputs = new Array(weight.length / values.length);
  for (let row = 0, k = 0; row < outputs.length; row++) {
    let sum = bias === null ? 0 : bias[row];
    for (let column = 0; column < values.length; column++, k++) sum += weight[k] * values[column];
    outputs[row] = sum;
  }
  return outputs;
}

/** LQR about a reference motion: force = u_ref − K (x − x_ref), as LqrController in lqr.py. */
class Lqr {
  constructor(data) {
    this.closed = data.closed;
    [this.x, this.u, this.k] = [data.x, data.u, data.k].map(unpacked);
    this.points = this.u.length / 2;
  }

  act(k, x) {
    const i = this.closed ? this.nearest(x) : Math.min(k, this.points - 1);
    return [0, 1].map((row) => {
      let force = this.u[2 * i + row];
      for (let j = 0; j < 8; j++) force -= this.k[16 * i + 8 * row + j] * (x[j] - this.x[8 * i + j]);
      return force;
    });
  }

  nearest(x) {
    let [best, least] = [0, Infinity];
    for (let i = 0; i < this.points; i++) {
      const distance = (this.x[8 * i] - x[0]) ** 2 + (this.x[8 * i + 1] - x[1]) ** 2;
      if (distance < least) [best, least] = [i, distance];
    }
    return best;
  }
}

const KNOWN = [1, 1, 1]; // factors on mass, height of the centre of mass, and force, that all controllers reckon with

/** One ballbot in a scenario under one controller, as BallbotEnv with physics="rk4". */
class Robot {
  constructor(controller, scenario, robot = KNOWN) {
    this.controller = controller;
    this.scenario = scenario;
    this.robot = robot;
    this.model = MODELS[scenario.task];
    this.reset(scenario.state);
  }

  reset(state) {
    this.x = [...state];
    this.before = this.x; // one control step ago, for pictures between the steps
    this.force = [0, 0];
    this.steps = 0;
    this.cost = 0;
    this.peak = this.tilt;
    this.ended = ""; // the limit that it violated, "goal", "force" without a finite one, or "over"
    this.path = [[this.x[0], this.x[1]]];
  }

  get tilt() {
    return Math.acos(Math.min(1, Math.max(-1, Math.cos(this.x[2]) * Math.cos(this.x[3]))));
  }

  get failed() {
    return !["", "goal", "over"].includes(this.ended);
  }

  /** Whether its episode is over: it failed or arrived, or the time is up. */
  get over() {
    const { optimum, duration } = this.scenario;
    return this.ended !== "" || (optimum !== null && this.steps * DATA.dt >= duration - 1e-9);
  }

  /** Holds a force for one control step. */
  advance() {
    this.before = this.x;
    if (this.ended) return;
    const limit = DATA.force_limit;
    const force = this.controller.act(this.steps, this.x, this.scenario.constants);
    if (!force.every(Number.isFinite)) {
      this.ended = "force";
      return;
    }
    const held = force.map((f) => this.robot[2] * Math.min(Math.max(f, -limit), limit));
    const [violated, arrived] = this.move(held, step(this.x, held, this.robot));
    if (violated >= 0) this.ended = this.model.limit_names[violated];
    else if (arrived) this.ended = "goal";
  }

  /** Counts a control step under a force, to the next state. Returns the index of the violated limit, or −1, and whether it is the goal. */
  move(force, next) {
    const [cost, ...end] = this.model.outcome(this.x, force, next, this.scenario.constants);
    if (!this.over) this.cost += cost; // an episode's cost ends with it
    [this.x, this.force] = [next, force];
    this.steps += 1;
    this.peak = Math.max(this.peak, this.tilt);
    this.path.push([this.x[0], this.x[1]]);
    return end;
  }

  /** A horizontal impulse on the body's centre of mass, N·s. */
  hit(impulse) {
    if (this.ended || !impulse.every(Number.isFinite)) return;
    this.x = push(this.x, impulse, this.robot);
  }
}

/** The optimum of a certified episode, which drives along its trajectory. */
class Optimum extends Robot {
  constructor(scenario) {
    super(null, scenario);
    [this.states, this.forces] = [scenario.best.x, scenario.best.u].map(unpacked);
  }

  advance() {
    this.before = this.x;
    if (this.ended) return;
    const k = this.steps;
    this.move(Array.from(this.forces.slice(2 * k, 2 * k + 2)), Array.from(this.states.slice(8 * k + 8, 8 * k + 16)));
    if (2 * this.steps >= this.forces.length) this.ended = "over";
  }
}

/** The way to the goal for a driver: a point of the optimum's path, a second beyond the one that is reached. */
class Guide {
  constructor(scenario) {
    this.states = unpacked(scenario.best.x);
    this.reached = 0; // never goes back, so that paths may cross themselves
  }

  point(k) {
    const at = 8 * Math.min(k, this.states.length / 8 - 1);
    return [this.states[at], this.states[at + 1]];
  }

  /** That point for a robot in state x. */
  ahead(x) {
    const distance = (k) => Math.hypot(this.point(k)[0] - x[0], this.point(k)[1] - x[1]);
    const near = Array.from({ length: A_SECOND + 1 }, (_, i) => this.reached + i);
    this.reached = near.reduce((best, k) => (distance(k) < distance(best) ? k : best));
    return this.point(this.reached + A_SECOND);
  }
}

const A_SECOND = Math.round(1 / DATA.dt); // control steps
const LOOK_AHEAD = 15; // control steps that are computed ahead in one of the episode

/** What an episode will cost if the policy takes over now: the cost so far, and nearly the least cost from here on. So it is never
 * less than the optimum. It is computed in many small parts. */
class Forecast {
  constructor(robot, scenario) {
    this.robot = robot;
    this.policy = new Policy(DATA.policies[scenario.task], MODELS[scenario.task]);
    this.cost = null; // where the policy does not reach the goal from here either, or nothing is computed yet
    this.restart();
  }

  /** Begins where the robot is now. */
  restart() {
    this.ahead = Object.assign(Object.create(Robot.prototype), this.robot, { controller: this.policy, path: [] });
  }

  advance() {
    for (let i = 0; i < LOOK_AHEAD && !this.ahead.over; i++) this.ahead.advance();
    if (!this.ahead.over) return;
    this.cost = this.ahead.failed ? null : this.ahead.cost;
    this.restart();
  }
}

const STEEPEST = 0.7; // rad, the lean that a stick commands that is fully out
const STIFFNESS = 60; // 1/s², how a lean is brought to the commanded one
const DAMPING = 14; // 1/s
const NOTCHES = 100; // of the stick on the way out: a drive is kept in whole ones, so that a replay is the same
const LONGEST = 5000; // control steps of a drive that is read
const SMOOTHING = 0.15; // share of the way to its goal that the stick goes in a control step: keys are pressed or not

/** A human, whose stick commands the lean. The force that gives it follows from one step of the model, linear in the force. */
class Driver {
  constructor() {
    this.stick = [0, 0]; // along x and y; at most 1 long
    this.goal = [0, 0]; // where the human holds it
    this.drive = []; // that in every control step, in notches
  }

  /** Holds the stick; more than a length of 1 counts as 1, and what is not finite as 0. */
  hold(x, y) {
    const length = Math.max(Math.hypot(x, y), 1);
    this.goal = Number.isFinite(length) ? [x / length, y / length] : [0, 0];
  }

  act(k, x) {
    if (k === 0) [this.stick, this.drive] = [[0, 0], []];
    const notches = (this.drive[k] = this.goal.map((value) => Math.round(NOTCHES * value)));
    this.stick = this.stick.map((value, i) => value + SMOOTHING * (notches[i] / NOTCHES - value));
    const [none, first, second] = [[0, 0], [100, 0], [0, 100]].map((force) => step(x, force, KNOWN).slice(6));
    const [p, q] = this.stick.map((value, i) => {
      const wanted = STIFFNESS * (STEEPEST * value - x[2 + i]) - DAMPING * x[6 + i];
      return x[6 + i] + DATA.dt * wanted - none[i];
    });
    const [a, b, c, d] = [first[0] - none[0], second[0] - none[0], first[1] - none[1], second[1] - none[1]];
    return [(d * p - b * q) / (a * d - b * c), (a * q - c * p) / (a * d - b * c)].map((share) => 100 * share);
  }
}

/** Replays a drive: nothing else holds the stick. */
class Replayed extends Driver {
  constructor(drive) {
    super();
    this.given = drive;
  }

  hold() {}

  act(k, x) {
    this.goal = (this.given[k] ?? [0, 0]).map((notches) => notches / NOTCHES);
    return super.act(k, x);
  }
}

/** A drive as letters that an address may have: how often, and which notches, again and again. */
function packedDrive(drive) {
  const runs = [];
  for (const [x, y] of drive) {
    const last = runs.at(-1);
    if (last && last[0] < 255 && last[1] === x + 128 && last[2] === y + 128) last[0] += 1;
    else runs.push([1, x + 128, y + 128]);
  }
  return btoa(String.fromCharCode(...runs.flat())).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}

/** The drive of such letters; null where they are none. */
function unpackedDrive(letters) {
  if (!/^[\w-]+$/.test(letters)) return null;
  let text;
  try {
    text = atob(letters.replaceAll("-", "+").replaceAll("_", "/"));
  } catch {
    return null;
  }
  const drive = [];
  for (let i = 0; i < text.length; i += 3) {
    const [count, x, y] = [0, 1, 2].map((k) => text.charCodeAt(i + k));
    if (!(Math.max(Math.abs(x - 128), Math.abs(y - 128)) <= NOTCHES) || drive.length + count > LONGEST) return null;
    for (let k = 0; k < count; k++) drive.push([x - 128, y - 128]);
  }
  return drive;
}

/** The robots of a scenario: the policy's, then LQR's; where a human drives, the human's, then the policy's. */
function robotsOf(scenario, driver = null, robot = KNOWN) {
  const learned = new Policy(DATA.policies[scenario.task], MODELS[scenario.task]);
  const controllers = driver ? [driver, learned] : [learned, new Lqr(scenario.lqr)];
  return controllers.map((controller) => new Robot(controller, scenario, robot));
}
