// The same episode under several controllers: a scene each, by scene.js. The data are states at 50 Hz.
"use strict";

// State and force of a take at time t, interpolated; it stays where it ended.
function sample(take, dt, t) {
  const last = take.x.length - 1;
  const place = Math.min(t / dt, last);
  const [n, share] = [Math.floor(place), place % 1];
  const x = take.x[n].map((from, i) => from + share * ((take.x[n + 1] ?? take.x[n])[i] - from));
  return { n, x, u: place < last ? take.u[n] : null };
}

const tiltOf = (gamma, theta) => (Math.acos(Math.min(1, Math.cos(gamma) * Math.cos(theta))) * 180) / Math.PI;

class Replay extends Player {
  constructor(root) {
    super(root);
    this.root = root;
    root.replay = this;
    this.data = JSON.parse(root.querySelector("script").textContent);
    this.chips = [...this.find("episodes").children];
    this.stages = [...this.find("stages").children].map((stage) => ({ stage, scene: this.scene(stage.querySelector("canvas")) }));
    this.chips.forEach((chip, index) => (chip.onclick = () => this.choose(index)));
    this.find("scrub").oninput = (event) => {
      this.setPlaying(false);
      this.seek(Number(event.target.value));
    };
    window.addEventListener("resize", () => this.draw());
    NIGHT.addEventListener("change", () => this.draw());
    this.choose(0);
  }

  // What draws on a canvas. A drag turns every camera, so that robots can be compared.
  scene(canvas) {
    let last = null;
    canvas.onpointerdown = (event) => {
      last = event;
      canvas.setPointerCapture(event.pointerId);
    };
    canvas.onpointermove = (event) => {
      if (!canvas.hasPointerCapture(event.pointerId)) return;
      for (const { scene } of this.stages) scene.turn(event.clientX - last.clientX, event.clientY - last.clientY);
      last = event;
      this.draw();
    };
    return new Scene(canvas, this.data);
  }

  choose(index) {
    this.setPlaying(false);
    this.episode = this.data.episodes[index];
    this.chips.forEach((chip, n) => chip.setAttribute("aria-pressed", n === index));
    const { takes, dt } = this.episode;
    this.end = dt * (Math.max(...takes.map((take) => take.x.length)) - 1);
    this.find("scrub").max = this.end;
    // every episode uses the same stages, because a browser has only so many scenes
    this.find("stages").replaceChildren(...takes.map((_, n) => this.stages[n].stage));
    takes.forEach((take, n) => {
      const { stage, scene } = this.stages[n];
      const label = stage.querySelector("b");
      label.textContent = take.label;
      label.style.setProperty("--robot", take.color);
      stage.querySelector(".note").textContent = take.note;
      scene.canvas.setAttribute("aria-label", `${take.label} in 3D; drag to turn the camera of every picture`);
    });
    this.seek(this.episode.poster);
    this.root.dataset.ready = "true";
  }

  seek(t) {
    this.time = Math.min(t, this.end);
    this.find("scrub").value = this.time;
    this.find("clock").textContent = this.time.toFixed(2) + " s";
    this.draw();
  }

  draw() {
    const { takes, dt, markers } = this.episode;
    takes.forEach((take, n) => {
      const { stage, scene } = this.stages[n];
      const now = sample(take, dt, this.time);
      stage.querySelector(".tilt").textContent = tiltOf(now.x[2], now.x[3]).toFixed(0) + "°";
      scene.camera.target = [...now.x.slice(0, 2), 0.5];
      const driven = [...take.x.slice(0, now.n + 1), now.x];
      const paths = [{ points: take.x, color: take.color, dashed: true }, { points: driven, color: take.color, dashed: false }];
      scene.draw({ robots: [{ x: now.x, yaw: now.x[4], u: now.u, color: take.color, alpha: 1 }], paths, markers });
    });
  }

  setPlaying(playing) {
    super.setPlaying(playing);
    if (playing && [this.end, this.episode.poster].includes(this.time)) this.time = 0;
  }

  tick(seconds) {
    if (!this.playing) return;
    this.seek(this.time + seconds);
    if (this.time >= this.end) this.setPlaying(false);
  }
}

for (const root of document.querySelectorAll(".replay")) new Replay(root);
