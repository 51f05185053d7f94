// The same episode under several controllers: a Plotly scene each, and traces of tilt and force in step with them.
// The data are states at 50 Hz; the robot's meshes are moved here.
"use strict";

const REACH = 1.7; // m, of the floor about a robot that is followed
const TOP = 1.5; // m, of a scene
const FORCE_SCALE = 1 / 500; // m/N
const AROUND = 18; // corners of a circle
const HIDDEN_AXIS = { visible: false, showspikes: false };

// A closed surface of revolution about z through rings [radius, height]; vertices as [x, y, z] columns.
function lathe(rings, color) {
  const mesh = { points: [], i: [], j: [], k: [], colors: [] };
  for (const [radius, height] of rings)
    for (let a = 0; a < AROUND; a++) {
      const angle = (2 * Math.PI * a) / AROUND;
      mesh.points.push([radius * Math.cos(angle), radius * Math.sin(angle), height]);
    }
  for (let ring = 0; ring + 1 < rings.length; ring++)
    for (let a = 0; a < AROUND; a++) {
      const [p, q] = [ring * AROUND + a, ring * AROUND + ((a + 1) % AROUND)];
      mesh.i.push(p, q);
      mesh.j.push(q, q + AROUND);
      mesh.k.push(p + AROUND, p + AROUND);
      mesh.colors.push(color, color);
    }
  return mesh;
}

function joined(a, b) {
  const shift = (list) => list.map((index) => index + a.points.length);
  return {
    points: a.points.concat(b.points),
    i: a.i.concat(shift(b.i)),
    j: a.j.concat(shift(b.j)),
    k: a.k.concat(shift(b.k)),
    colors: a.colors.concat(b.colors),
  };
}

const sphere = (radius, color) =>
  lathe([...Array(9).keys()].map((n) => [radius * Math.sin((Math.PI * n) / 8), -radius * Math.cos((Math.PI * n) / 8)]), color);
const cylinder = (radius, low, high, color) => lathe([[0, low], [radius, low], [radius, high], [0, high]], color);

const columns = (points) => ({ x: points.map((p) => p[0]), y: points.map((p) => p[1]), z: points.map((p) => p[2]) });

function meshTrace(mesh, opacity = 1) {
  const lighting = { ambient: 0.85, diffuse: 0.5, specular: 0.1, roughness: 0.7, fresnel: 0 };
  const { i, j, k } = mesh;
  return { type: "mesh3d", ...columns(mesh.points), i, j, k, facecolor: mesh.colors, flatshading: true, opacity,
    lighting, lightposition: { x: -1000, y: -2000, z: 3000 }, hoverinfo: "skip" };
}

function lineTrace(points, color, width, dash = "solid") {
  return { type: "scatter3d", mode: "lines", ...columns(points), line: { color, width, dash }, hoverinfo: "skip" };
}

function markerTrace(marker) {
  const { x, y, radius, height, color, ring } = marker;
  if (!ring) {
    const mesh = cylinder(radius, 0, height, color);
    mesh.points = mesh.points.map(([px, py, pz]) => [px + x, py + y, pz]);
    return meshTrace(mesh);
  }
  const around = [...Array(73).keys()].map((n) => (2 * Math.PI * n) / 72);
  return lineTrace(around.map((a) => [x + radius * Math.cos(a), y + radius * Math.sin(a), 0.015]), color, 5, "dash");
}

// Every other square metre of the floor.
function floorTrace([x0, x1, y0, y1]) {
  const floor = { points: [], i: [], j: [], k: [], colors: [] };
  for (let x = Math.floor(x0); x < x1; x++)
    for (let y = Math.floor(y0); y < y1; y++) {
      if ((x + y) % 2) continue;
      const n = floor.points.length;
      floor.points.push([x, y, 0], [x + 1, y, 0], [x + 1, y + 1, 0], [x, y + 1, 0]);
      floor.i.push(n, n);
      floor.j.push(n + 1, n + 2);
      floor.k.push(n + 2, n + 3);
      floor.colors.push("#dfe4ec", "#dfe4ec");
    }
  return { ...meshTrace(floor), lighting: { ambient: 1, diffuse: 0, specular: 0 } };
}

// State of a take at time t: x, y, gamma, theta, fx, fy, interpolated; it stays where it ended.
function sample(take, dt, t) {
  const last = take.x.length - 1;
  const place = Math.min(t / dt, last);
  const [n, share] = [Math.floor(place), place % 1];
  const at = (name) => take[name][n] + share * ((take[name][n + 1] ?? take[name][n]) - take[name][n]);
  const force = place < last ? [take.fx[n], take.fy[n]] : [0, 0];
  return { n, x: at("x"), y: at("y"), gamma: at("gamma"), theta: at("theta"), force };
}

const tiltOf = (gamma, theta) => (Math.acos(Math.min(1, Math.cos(gamma) * Math.cos(theta))) * 180) / Math.PI;

class Replay {
  constructor(root) {
    this.root = root;
    this.data = JSON.parse(root.querySelector("script").textContent);
    this.time = 0;
    this.playing = false;
    this.find = (name) => root.querySelector("." + name);
    const { ball_radius, body_radius, body_length, com_height } = this.data.robot;
    this.ball = sphere(ball_radius, "#2a2f3a");
    this.body = (color) => cylinder(body_radius, com_height - body_length / 2, com_height + body_length / 2, color);
    this.addControls();
    this.choose(0);
  }

  addControls() {
    const chips = this.find("episodes");
    this.data.episodes.forEach((episode, index) => {
      const chip = document.createElement("button");
      chip.className = "chip";
      chip.textContent = episode.title;
      chip.onclick = () => this.choose(index);
      chips.append(chip);
    });
    this.find("play").onclick = () => (this.playing ? this.pause() : this.play());
    this.find("scrub").oninput = (event) => {
      this.pause();
      this.seek(Number(event.target.value));
    };
    this.find("follow").onchange = () => this.seek(this.time);
  }

  async choose(index) {
    this.pause();
    this.episode = this.data.episodes[index];
    [...this.find("episodes").children].forEach((chip, n) => chip.setAttribute("aria-pressed", n === index));
    const { takes, dt } = this.episode;
    this.end = dt * (Math.max(...takes.map((take) => take.x.length)) - 1);
    this.find("scrub").max = this.end;
    this.setBounds();
    (this.views ?? []).forEach((view) => Plotly.purge(view));
    this.find("stages").replaceChildren(...takes.map((take) => this.makeStage(take)));
    this.views = [...this.root.querySelectorAll(".view")];
    this.time = 0;
    await Promise.all(this.views.map((view, n) => this.makeScene(view, takes[n])));
    this.drawTraces();
    await this.seek(0);
    this.root.dataset.ready = "true";
  }

  // The floor that holds every path, square, so that all scenes have one scale.
  setBounds() {
    const { takes, markers } = this.episode;
    const spread = (name) => {
      const values = takes.flatMap((take) => take[name]);
      for (const m of markers) values.push(m[name] - m.radius, m[name] + m.radius);
      return [Math.min(...values), Math.max(...values)];
    };
    const [[x0, x1], [y0, y1]] = [spread("x"), spread("y")];
    const half = Math.max(x1 - x0, y1 - y0, 2 * REACH) / 2 + 0.6;
    const [cx, cy] = [(x0 + x1) / 2, (y0 + y1) / 2];
    this.bounds = [cx - half, cx + half, cy - half, cy + half];
  }

  makeStage(take) {
    const stage = document.createElement("div");
    stage.className = "stage";
    stage.innerHTML = '<div class="caption"><b></b><span class="tilt"></span></div><div class="note"></div><div class="view"></div>';
    const label = stage.querySelector("b");
    label.textContent = take.label;
    label.style.borderColor = take.color;
    stage.querySelector(".note").textContent = take.note;
    return stage;
  }

  async makeScene(view, take) {
    take.mesh = joined(this.ball, this.body(take.color));
    const [x0, x1, y0, y1] = this.bounds;
    const wide = [x0 - REACH - 1, x1 + REACH + 1, y0 - REACH - 1, y1 + REACH + 1];
    const way = take.x.map((x, n) => [x, take.y[n], 0.008]);
    const traces = [
      meshTrace(take.mesh), // 0: the robot
      lineTrace([], take.color, 6), // 1: its way so far
      lineTrace([], "#d81b8c", 8), // 2: the force
      floorTrace(wide),
      lineTrace(way, take.color, 2, "dot"),
      ...this.episode.markers.map(markerTrace),
    ];
    const camera = { eye: { x: -0.5, y: -0.72, z: 0.2 }, center: { x: 0, y: 0, z: -0.06 }, projection: { type: "perspective" } };
    const layout = {
      margin: { l: 0, r: 0, t: 0, b: 0 }, showlegend: false, paper_bgcolor: "rgba(0,0,0,0)", uirevision: "keep",
      scene: { aspectmode: "manual", camera, xaxis: HIDDEN_AXIS, yaxis: HIDDEN_AXIS, zaxis: HIDDEN_AXIS, dragmode: "orbit" },
    };
    await Plotly.newPlot(view, traces, { ...layout, scene: { ...layout.scene, ...this.window(take, 0) } },
      { displayModeBar: false, responsive: true, scrollZoom: false });
    view.on("plotly_relayout", (change) => this.linkCameras(view, change["scene.camera"]));
  }

  // Ranges and proportions of a scene: about the robot, or all of the floor.
  window(take, t) {
    let [x0, x1, y0, y1] = this.bounds;
    if (this.find("follow").checked) {
      const { x, y } = sample(take, this.episode.dt, t);
      [x0, x1, y0, y1] = [x - REACH, x + REACH, y - REACH, y + REACH];
    }
    const axis = (range) => ({ ...HIDDEN_AXIS, range, autorange: false });
    return { xaxis: axis([x0, x1]), yaxis: axis([y0, y1]), zaxis: axis([0, TOP]), aspectratio: { x: 1, y: 1, z: TOP / (x1 - x0) } };
  }

  linkCameras(source, camera) {
    if (!camera || this.linking || !this.find("link").checked) return;
    this.linking = true;
    const others = this.views.filter((view) => view !== source);
    Promise.all(others.map((view) => Plotly.relayout(view, { "scene.camera": camera }))).finally(() => (this.linking = false));
  }

  drawTraces() {
    const { takes, dt } = this.episode;
    const plot = (name, title, valuesOf) => {
      const lines = takes.map((take) => {
        const y = valuesOf(take);
        return { x: y.map((_, n) => n * dt), y, mode: "lines", name: take.label.replaceAll("&", "&amp;").replaceAll("<", "&lt;"), line: { color: take.color, width: 2 } };
      });
      const layout = {
        title: { text: title, font: { size: 13 }, x: 0.02, y: 0.97 }, margin: { l: 42, r: 10, t: 28, b: 36 }, showlegend: false,
        xaxis: { title: { text: "time, s", standoff: 4 }, range: [0, this.end], fixedrange: true, gridcolor: "#eef0f3" },
        yaxis: { rangemode: "tozero", fixedrange: true, gridcolor: "#eef0f3" }, hovermode: "x unified",
        shapes: [{ type: "line", x0: 0, x1: 0, yref: "paper", y0: 0, y1: 1, line: { color: "#1d2430", width: 1.5 } }],
      };
      return Plotly.react(this.find(name), lines, layout, { displayModeBar: false, responsive: true });
    };
    plot("tilts", "tilt, deg", (take) => take.gamma.map((gamma, n) => tiltOf(gamma, take.theta[n])));
    plot("forces", "force, N", (take) => take.fx.map((fx, n) => Math.hypot(fx, take.fy[n])));
  }

  async seek(t) {
    this.time = Math.min(t, this.end);
    this.find("scrub").value = this.time;
    this.find("clock").textContent = this.time.toFixed(2) + " s";
    const { takes } = this.episode;
    const cursor = { "shapes[0].x0": this.time, "shapes[0].x1": this.time };
    await Promise.all([
      ...this.views.map((view, n) => this.moveRobot(view, takes[n])),
      ...["tilts", "forces"].map((name) => Plotly.relayout(this.find(name), cursor)),
    ]);
  }

  moveRobot(view, take) {
    const { n, x, y, gamma, theta, force } = sample(take, this.episode.dt, this.time);
    const { ball_radius } = this.data.robot;
    const [sg, cg, st, ct] = [Math.sin(gamma), Math.cos(gamma), Math.sin(theta), Math.cos(theta)];
    // R = Ry(gamma) Rx(-theta), as in the URDF
    const points = take.mesh.points.map(([a, b, c]) => {
      const [b2, c2] = [ct * b + st * c, ct * c - st * b];
      return [x + cg * a + sg * c2, y + b2, ball_radius + cg * c2 - sg * a];
    });
    const way = take.x.slice(0, n + 1).map((px, k) => [px, take.y[k], 0.015]).concat([[x, y, 0.015]]);
    const tip = [x + FORCE_SCALE * force[0], y + FORCE_SCALE * force[1], ball_radius];
    const moved = [columns(points), columns(way), columns([[x, y, ball_radius], tip])];
    view.closest(".stage").querySelector(".tilt").textContent = tiltOf(gamma, theta).toFixed(0) + "°";
    const place = this.window(take, this.time);
    const layout = { "scene.xaxis.range": place.xaxis.range, "scene.yaxis.range": place.yaxis.range, "scene.aspectratio": place.aspectratio };
    const restyle = { x: moved.map((m) => m.x), y: moved.map((m) => m.y), z: moved.map((m) => m.z) };
    return Plotly.update(view, restyle, layout, [0, 1, 2]);
  }

  play() {
    if (this.time >= this.end) this.time = 0;
    this.playing = true;
    this.find("play").textContent = "Pause";
    let last = performance.now();
    const tick = async (now) => {
      if (!this.playing) return;
      const step = ((now - last) / 1000) * Number(this.find("speed").value);
      last = now;
      await this.seek(this.time + Math.max(0, step));
      if (this.time >= this.end) this.pause();
      else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  pause() {
    this.playing = false;
    this.find("play").textContent = "Play";
  }
}

for (const root of document.querySelectorAll(".replay")) new Replay(root);
