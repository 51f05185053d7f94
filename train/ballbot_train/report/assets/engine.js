// The playground's mathematics, without a page: robots that a policy or LQR controls. `step`, `push`, `MODELS` and `DATA`
// come before it, printed by playground.py. The same code runs in the browser and, in tests, in node.
"use strict";

/** Numbers that Python packed, as an array. */
function unpacked(base64, Kind) {
  const text = atob(base64);
  const bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  return new Kind(bytes.buffer);
}

const ACTIVATIONS = { tanh: Math.tanh, relu: (a) => Math.max(a, 0), silu: (a) => a / (1 + Math.exp(-a)) };

/** A learned policy: force = limit · squash(W o + MLP(o)), averaged over mirror images or seen in a frame, as in policy.py. */
class Policy {
  constructor(data, model) {
    this.data = data;
    this.model = model;
    const layer = ({ weight, bias }) => ({
      weight: unpacked(weight, Float32Array),
      bias: bias === null ? null : unpacked(bias, Float32Array),
    });
    this.layers = data.layers.map(layer);
    this.linear = data.linear === null ? null : layer(data.linear);
    this.routes = data.routes.map(layer);
  }

  reset() {}

  act(k, x, c) {
    const observation = Array.from(Float32Array.from(this.model.observe(x, c)));
    const squash = this.data.squash === "tanh" ? Math.tanh : (a) => Math.min(Math.max(a, -1), 1);
    return this.raw(observation).map((a) => DATA.force_limit * Math.fround(squash(a)));
  }

  raw(observation) {
    if (this.model.features) {
      const seen = this.routes.length ? [...observation, ...this.sides(observation)] : observation;
      return this.model.back(seen, this.inFrame(this.model.features(seen)));
    }
    const total = this.sum(observation);
    for (const [signs, action] of this.data.mirrors) {
      const mirrored = this.sum(observation.map((value, i) => signs[i] * value));
      total.forEach((_, i) => (total[i] += action[i] * mirrored[i]));
    }
    return total.map((value) => value / (1 + this.data.mirrors.length));
  }

  /** The action in the frame; of a centred policy it is exact in the frame's steady motion. */
  inFrame(features) {
    let output = this.sum(features);
    if (this.data.centred) {
      const steady = this.model.steady(features);
      const kept = this.sum(steady.slice(0, features.length));
      const needed = steady.slice(features.length).map((action) => unsquashed(action, this.data.squash));
      output = output.map((value, i) => value - kept[i] + needed[i]);
    }
    return this.data.squash === "tanh_in_frame" ? output.map((value) => DATA.reach * Math.tanh(value)) : output;
  }

  /** On which side each obstacle is passed. The outputs belong to the choices of farther sides, the first to none. */
  sides(observation) {
    const outputs = network(this.routes, Math.tanh, this.model.layout(observation));
    const best = outputs.indexOf(Math.max(...outputs));
    const obstacles = Math.log2(outputs.length);
    const farther = Array.from({ length: obstacles }, (_, i) => ((best >> (obstacles - 1 - i)) & 1 ? -1 : 1));
    return this.model.chosen_sides(observation, farther);
  }

  sum(inputs) {
    const values = network(this.layers, ACTIVATIONS[this.data.activation], inputs);
    return this.linear === null ? values : affine(this.linear, inputs).map((value, i) => value + values[i]);
  }
}

/** Layers with an activation between them. */
function network(layers, activate, inputs) {
  return layers.reduce((values, layer, i) => affine(layer, i === 0 ? values : values.map(activate)), inputs);
}

/** What a network has to give for an action, before it is squashed. */
function unsquashed(action, squash) {
  if (squash === "clip") return action;
  return Math.atanh(Math.min(Math.max(action / (squash === "tanh_in_frame" ? DATA.reach : 1), -0.999), 0.999));
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
    [this.x, this.u, this.k] = [data.x, data.u, data.k].map((part) => unpacked(part, Float64Array));
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
    this.move(held, step(this.x, held, this.robot));
    this.judge();
  }

  /** Counts a control step under a force, to the next state. */
  move(force, next) {
    const { optimum, duration, constants } = this.scenario;
    const counts = optimum === null || this.steps * DATA.dt < duration - 1e-9; // an episode's cost ends with it
    if (counts) this.cost += this.model.cost(this.x, force, constants)[0] * DATA.dt;
    [this.x, this.force] = [next, force];
    this.steps += 1;
    this.peak = Math.max(this.peak, this.tilt);
    this.path.push([this.x[0], this.x[1]]);
  }

  /** A horizontal impulse on the body's centre of mass, N·s. */
  hit(impulse) {
    if (this.ended || !impulse.every(Number.isFinite)) return;
    this.x = push(this.x, impulse, this.robot);
  }

  judge() {
    const c = this.scenario.constants;
    const violated = this.model.limits(this.x, c).findIndex((limit) => !(limit >= 0));
    if (violated >= 0) this.ended = this.model.limit_names[violated];
    else if (this.model.first_exit && this.model.goal(this.x, c).every((excess) => excess <= 0)) this.ended = "goal";
  }
}

/** The optimum of a certified episode, which drives along its trajectory. */
class Optimum extends Robot {
  constructor(scenario) {
    super(null, scenario);
    [this.states, this.forces] = [scenario.best.x, scenario.best.u].map((part) => unpacked(part, Float32Array));
  }

  advance() {
    this.before = this.x;
    if (this.ended) return;
    const k = this.steps;
    this.move(Array.from(this.forces.slice(2 * k, 2 * k + 2)), Array.from(this.states.slice(8 * k + 8, 8 * k + 16)));
    if (2 * this.steps >= this.forces.length) this.ended = "over";
  }
}

const STEEPEST = 0.7; // rad, the lean that a stick commands that is fully out
const STIFFNESS = 60; // 1/s², how a lean is brought to the commanded one
const DAMPING = 14; // 1/s
const SMOOTHING = 0.15; // share of the way to its goal that the stick goes in a control step: keys know no half way

/** A human, whose stick commands the lean. The force that gives it follows from one step of the model, linear in the force. */
class Driver {
  constructor() {
    this.stick = [0, 0]; // along x and y; at most 1 long
    this.goal = [0, 0]; // where the human holds it
  }

  /** Holds the stick; more than a length of 1 counts as 1, and what is not finite as 0. */
  hold(x, y) {
    const length = Math.max(Math.hypot(x, y), 1);
    this.goal = Number.isFinite(length) ? [x / length, y / length] : [0, 0];
  }

  act(k, x) {
    this.stick = this.stick.map((value, i) => value + SMOOTHING * (this.goal[i] - value));
    const [none, first, second] = [[0, 0], [100, 0], [0, 100]].map((force) => step(x, force, KNOWN).slice(6));
    const [p, q] = this.stick.map((value, i) => {
      const wanted = STIFFNESS * (STEEPEST * value - x[2 + i]) - DAMPING * x[6 + i];
      return x[6 + i] + DATA.dt * wanted - none[i];
    });
    const [a, b, c, d] = [first[0] - none[0], second[0] - none[0], first[1] - none[1], second[1] - none[1]];
    return [(d * p - b * q) / (a * d - b * c), (a * q - c * p) / (a * d - b * c)].map((share) => 100 * share);
  }
}

/** The robots of a scenario: the policy's, then LQR's; where a human drives, the human's, then the policy's. */
function robotsOf(scenario, driver = null, robot = KNOWN) {
  const learned = new Policy(DATA.policies[scenario.task], MODELS[scenario.task]);
  const controllers = driver ? [driver, learned] : [learned, new Lqr(scenario.lqr)];
  return controllers.map((controller) => new Robot(controller, scenario, robot));
}
