// Draws ballbots with WebGL 2: a floor, robots and translucent ghosts with shadows, markers, paths and arrows. What it draws is
// described as in ballbot_gym.drawing. No library: the ones that draw in 3D are larger than all the rest of the page.
"use strict";

const FIELD_OF_VIEW = 0.7; // rad, vertical
const [NEAREST, FARTHEST] = [0.1, 200]; // m, from the camera, of what is drawn
const SHADOW = [0.1, 0.13, 0.2, 0.2];
const LIGHT = [-0.36, -0.44, 0.82]; // towards it, of length 1
/** Colours of sky, bright and dark squares. */
const DAY = { sky: [0.933, 0.949, 0.973], bright: [0.985, 0.985, 0.985], dim: [0.83, 0.86, 0.905] };
const DARK = { sky: [0.075, 0.09, 0.12], bright: [0.27, 0.3, 0.35], dim: [0.2, 0.225, 0.27] };
const NIGHT = matchMedia("(prefers-color-scheme: dark)");

const VERTEX = `#version 300 es
layout(location = 0) in vec3 position; layout(location = 1) in vec3 normal;
uniform mat4 place, camera;
out vec3 at, up;
void main() {
  vec4 world = place * vec4(position, 1.0);
  at = world.xyz; up = mat3(place) * normal;
  gl_Position = camera * world;
}`;
const [PLAIN, LIT, FLOOR, DASHED] = [0, 1, 2, 3]; // looks: of one colour, the same in the light, the floor's squares, with gaps
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 at, up;
uniform vec3 eye, light, sky, bright, dim; uniform vec4 color; uniform int look;
out vec4 pixel;
void main() {
  if (look == ${FLOOR}) {
    vec2 wide = max(fwidth(at.xy), 1e-4), p = at.xy;
    // the share of dark squares in the pixel, so that far squares do not flicker
    vec2 wave = 2.0 * (abs(fract((p - 0.5 * wide) * 0.5) - 0.5) - abs(fract((p + 0.5 * wide) * 0.5) - 0.5)) / wide;
    float dark = 0.5 - 0.5 * wave.x * wave.y;
    float far = smoothstep(5.0, 26.0, distance(at.xy, eye.xy));
    pixel = vec4(mix(mix(bright, dim, dark), sky, far), 1.0);
  } else if (look == ${LIT}) {
    vec3 n = normalize(up), e = normalize(eye - at);
    float diffuse = max(dot(n, light), 0.0);
    float shine = pow(max(dot(n, normalize(light + e)), 0.0), 40.0);
    pixel = vec4(color.rgb * (0.52 + 0.16 * n.z + 0.5 * diffuse) + 0.22 * shine, color.a);
  } else {
    if (look == ${DASHED} && fract(up.x) > 0.5) discard;
    pixel = color;
  }
}`;

/** Places of bodies: matrices in columns, from axes and origin, and of what is upright, from radius, height and (x, y), m. */
const framed = (x, y, z, at) => [...x, 0, ...y, 0, ...z, 0, ...at, 1];
const upright = (radius, height, [x, y], z = 0) => framed([radius, 0, 0], [0, radius, 0], [0, 0, height], [x, y, z]);

const Vector = {
  minus: (a, b) => a.map((v, i) => v - b[i]),
  plus: (a, b, scale = 1) => a.map((v, i) => v + scale * b[i]),
  times: (a, s) => a.map((v) => v * s),
  cross: (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
  unit: (a) => Vector.times(a, 1 / Math.hypot(...a)),
};

/** Triangles as [x, y, z, nx, ny, nz] per corner. */
const Mesh = {
  /** A surface of revolution about z through points (radius, z) with normals (nr, nz). */
  turned(profile, sides = 40) {
    const corner = ([r, z, nr, nz], a) => [r * Math.cos(a), r * Math.sin(a), z, nr * Math.cos(a), nr * Math.sin(a), nz];
    const out = [];
    for (let k = 0; k + 1 < profile.length; k++) {
      for (let i = 0; i < sides; i++) {
        const [a, b] = [(2 * Math.PI * i) / sides, (2 * Math.PI * (i + 1)) / sides];
        const [p, q, r, s] = [corner(profile[k], a), corner(profile[k], b), corner(profile[k + 1], b), corner(profile[k + 1], a)];
        out.push(...p, ...q, ...r, ...p, ...r, ...s);
      }
    }
    return out;
  },
  sphere() {
    const angles = Array.from({ length: 21 }, (_, i) => (Math.PI * i) / 20 - Math.PI / 2);
    return Mesh.turned(angles.map((a) => [Math.cos(a), Math.sin(a), Math.cos(a), Math.sin(a)]));
  },
  /** Radius 1, from z = 0 to 1. */
  cylinder: () => Mesh.turned([[0, 0, 0, -1], [1, 0, 0, -1], [1, 0, 1, 0], [1, 1, 1, 0], [1, 1, 0, 1], [0, 1, 0, 1]]),
  cone: () => Mesh.turned([[0, 0, 0, -1], [1, 0, 0, -1], [1, 0, 0.7, 0.7], [0, 1, 0.7, 0.7]]),
  /** A band along points (x, y); its normals' x counts the pairs of a dash and a gap of this length each, m. */
  band(points, width, dash) {
    const out = [];
    let along = 0; // pairs
    for (let i = 0; i + 1 < points.length; i++) {
      const [a, b] = [points[i], points[i + 1]].map(([x, y]) => [x, y]);
      const way = Vector.minus(b, a);
      const length = Math.hypot(...way);
      if (length < 1e-9) continue;
      const side = [-way[1], way[0]].map((part) => (0.5 * width * part) / length);
      const corner = (end, sign) => [...Vector.plus(end, side, sign), 0, along, 0, 1];
      const [p, q] = [corner(a, -1), corner(a, 1)];
      along += length / (2 * dash);
      const [r, s] = [corner(b, 1), corner(b, -1)];
      out.push(...p, ...s, ...r, ...p, ...r, ...q);
    }
    return out;
  },
};

/** A colour "#rrggbb", lighter in the dark, as in the pages' styles; one of a marker's, in shares, stays. */
function rgb(color) {
  if (typeof color !== "string") return color.slice(0, 3);
  const parts = [1, 3, 5].map((i) => parseInt(color.slice(i, i + 2), 16) / 255);
  return NIGHT.matches ? parts.map((part) => 0.35 + 0.65 * part) : parts;
}

/** What plays on a page, with its button and its choice of speeds. */
class Player {
  constructor(root) {
    this.find = (name) => root.querySelector("." + name);
    this.find("play").onclick = () => this.setPlaying(!this.playing);
    this.wait(performance.now());
  }

  /** Calls `tick` in every frame, with the seconds by which time advances, and the seconds that have passed, at most 0.1. */
  wait(last) {
    requestAnimationFrame((now) => {
      const passed = Math.min(Math.max(now - last, 0) / 1000, 0.1);
      this.tick(this.playing ? passed * Number(this.find("speed").value) : 0, passed);
      this.wait(now);
    });
  }

  setPlaying(playing) {
    this.playing = playing;
    this.find("play").textContent = playing ? "Pause" : "Play";
  }
}

/** A robot's points in state x, m, and its body's axes, the last one upwards. γ turns about y, then θ about the turned −x. */
function pose({ ball_radius, com_height, body_length }, x) {
  const [sg, cg, st, ct] = [Math.sin(x[2]), Math.cos(x[2]), Math.sin(x[3]), Math.cos(x[3])];
  const axes = [[cg, 0, -sg], [-sg * st, ct, -cg * st], [sg * ct, st, cg * ct]];
  const ball = [x[0], x[1], ball_radius];
  const [low, body, top] = [-0.5, 0, 0.5].map((share) => Vector.plus(ball, axes[2], com_height + share * body_length));
  return { ball, low, body, top, axes };
}

class Scene {
  /** Says so and throws where the browser has no WebGL 2. `look` holds a robot's measures, colours and the scale of forces. */
  constructor(canvas, look) {
    this.canvas = canvas;
    this.look = look;
    const gl = (this.gl = canvas.getContext("webgl2", { alpha: false, antialias: true, stencil: true }));
    if (!gl) {
      canvas.replaceWith("The robots cannot be drawn: this browser has no WebGL 2.");
      throw new Error("no WebGL 2");
    }
    this.at = this.program();
    for (const name of ["sphere", "cylinder", "cone"]) this[name] = this.mesh(Mesh[name](), gl.STATIC_DRAW);
    this.strip = this.mesh([], gl.DYNAMIC_DRAW);
    this.camera = { yaw: -2.2, pitch: 0.34, distance: 3.6, target: [0, 0, 0.5] };
  }

  /** Compiles the shaders; returns where their uniforms are, by name. */
  program() {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    const names = ["place", "camera", "color", "eye", "light", "look", "sky", "bright", "dim"];
    return Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)]));
  }

  mesh(corners, usage) {
    const gl = this.gl;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(corners), usage);
    for (const i of [0, 1]) {
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, 3, gl.FLOAT, false, 24, 12 * i);
    }
    return { array, buffer, count: corners.length / 6 };
  }

  /** Turns the camera by a drag, px. */
  turn(right, down) {
    this.camera.yaw -= right * 0.008;
    this.camera.pitch = Math.min(Math.max(this.camera.pitch + down * 0.006, 0.05), 1.45);
  }

  /** Fits the drawing buffer to the canvas, and computes where the camera is. */
  aim() {
    const { canvas, gl } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio].map((v) => Math.max(1, Math.round(v)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    const { yaw, pitch, distance, target } = this.camera;
    this.back = [Math.cos(yaw) * Math.cos(pitch), Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch)];
    this.eye = Vector.plus(target, this.back, distance);
    this.right = Vector.unit(Vector.cross([0, 0, 1], this.back));
    const place = framed(this.right, Vector.cross(this.back, this.right), this.back, this.eye);
    const f = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const depth = (FARTHEST + NEAREST) / (NEAREST - FARTHEST);
    const lens = [(f * height) / width, 0, 0, 0, 0, f, 0, 0, 0, 0, depth, -1, 0, 0, NEAREST * (depth - 1), 0];
    this.matrix = new DOMMatrix(lens).multiply(new DOMMatrix(place).inverse());
  }

  /** Where a point (3,), m, is on the canvas, CSS pixels; null behind the camera. */
  project(point) {
    const { x, y, w } = this.matrix.transformPoint(new DOMPoint(...point));
    if (w <= 0.05) return null;
    return [((1 + x / w) / 2) * this.canvas.clientWidth, ((1 - y / w) / 2) * this.canvas.clientHeight];
  }

  /** The point at height z, m, that a pixel of the canvas shows; null above the horizon. */
  unproject([px, py], z) {
    const { clientWidth, clientHeight } = this.canvas;
    const shown = new DOMPoint((2 * px) / clientWidth - 1, 1 - (2 * py) / clientHeight, 1); // in the farthest plane
    const far = this.matrix.inverse().transformPoint(shown);
    const ray = Vector.minus([far.x / far.w, far.y / far.w, far.z / far.w], this.eye);
    const t = (z - this.eye[2]) / ray[2];
    return t > 0 && t * FARTHEST < 60 ? Vector.plus(this.eye, ray, t) : null;
  }

  /** A drawing: robots {x, yaw, color, u, alpha, push, goal}, ghosts first, paths {points, color, dashed} and markers. */
  draw({ robots, paths, markers }) {
    const { gl, at } = this;
    this.aim();
    const theme = NIGHT.matches ? DARK : DAY;
    gl.clearColor(...theme.sky, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.uniformMatrix4fv(at.camera, false, this.matrix.toFloat32Array());
    for (const [name, value] of Object.entries({ eye: this.eye, light: LIGHT, ...theme })) gl.uniform3fv(at[name], value);
    const posts = markers.filter((marker) => marker.height >= 0.1);
    this.put(this.cylinder, upright(60, 0, this.camera.target), [1, 1, 1, 1], FLOOR);
    gl.depthMask(false);
    for (const marker of markers) if (!posts.includes(marker)) this.drawFlat(marker);
    for (const path of paths) this.drawBand(path.points, rgb(path.color), path.dashed ? 0.09 : Infinity);
    this.drawShadows(robots, posts);
    gl.depthMask(true);
    for (const post of posts) this.drawPost(post);
    for (const robot of robots) if (robot.alpha === 1) this.drawRobot(robot);
    gl.enable(gl.BLEND);
    for (const robot of robots) {
      if (robot.alpha === 1) continue;
      gl.colorMask(false, false, false, false); // depth first, so that a ghost's far side does not show through
      this.drawRobot(robot);
      gl.colorMask(true, true, true, true);
      this.drawRobot(robot);
    }
    gl.disable(gl.BLEND);
  }

  /** A mesh at a place; a shadow's has no normals left, and so one colour. */
  put({ array, count }, place, color, look = LIT) {
    const { gl, at } = this;
    gl.bindVertexArray(array);
    gl.uniformMatrix4fv(at.place, false, place);
    gl.uniform4fv(at.color, this.isShadow ? SHADOW : color);
    gl.uniform1i(at.look, this.isShadow ? PLAIN : look);
    gl.drawArrays(gl.TRIANGLES, 0, count);
  }

  drawPost({ position, radius, height, color }) {
    this.put(this.cylinder, upright(radius, height, position), color);
  }

  drawRobot({ x, yaw = 0, color, u, alpha, push, goal }) {
    const { robot, colors, least_force, force_scale, push_scale } = this.look;
    const { ball, low, body, axes } = pose(robot, x);
    this.put(this.sphere, upright(robot.ball_radius, robot.ball_radius, x, robot.ball_radius), [...rgb(colors.ball), alpha]);
    const sides = [robot.body_radius, robot.body_radius, robot.body_length].map((size, i) => Vector.times(axes[i], size));
    this.put(this.cylinder, framed(...sides, low), [...rgb(color), alpha]);
    if (robot.wheel_radius) this.drawWheels(ball, axes, yaw, [...rgb(colors.ball), alpha]);
    if (this.isShadow) return;
    if (u?.length === 2 && Math.hypot(...u) > least_force) this.drawArrow(ball, Vector.times([...u, 0], force_scale), colors.force, alpha);
    if (push) this.drawArrow(body, Vector.times([...push, 0], push_scale), colors.push, alpha);
    if (goal) this.drawGoal(x, goal, colors.goal);
  }

  /** Three wheels that touch the ball at 45° of zenith angle, 120° apart about the body's axis; see omni.py. */
  drawWheels(ball, [east, north, up], yaw, color) {
    const { ball_radius, wheel_radius } = this.look.robot;
    for (const azimuth of [0, 1, 2].map((i) => yaw + (2 * Math.PI * i) / 3)) {
      const out = Vector.plus(Vector.times(east, Math.cos(azimuth)), north, Math.sin(azimuth));
      const along = Vector.plus(Vector.times(east, -Math.sin(azimuth)), north, Math.cos(azimuth));
      const normal = Vector.times(Vector.plus(out, up), Math.SQRT1_2);
      const axle = Vector.times(Vector.cross(normal, along), 0.6 * wheel_radius);
      const middle = Vector.plus(ball, normal, ball_radius + wheel_radius);
      const [across, ahead] = [normal, along].map((side) => Vector.times(side, wheel_radius));
      this.put(this.cylinder, framed(across, ahead, axle, Vector.plus(middle, axle, -0.5)), color);
    }
  }

  /** An arrow on the floor, from a robot towards a point that is not close to it. */
  drawGoal([x, y], goal, color) {
    const way = [goal[0] - x, goal[1] - y, 0];
    const distance = Math.hypot(...way);
    if (distance < 0.6) return;
    const unit = Vector.times(way, 1 / distance);
    this.drawArrow(Vector.plus([x, y, 0.03], unit, 0.25), Vector.times(unit, Math.min(0.7, distance - 0.4)), color, 1);
  }

  /** An arrow from a point along a level vector, m. */
  drawArrow(from, vector, color, alpha) {
    const length = Math.hypot(...vector);
    if (length < 1e-3) return;
    const head = Math.min(0.16, length);
    const axis = Vector.times(vector, 1 / length);
    const aside = Vector.cross(axis, [0, 0, 1]);
    const part = (mesh, radius, size, at) => {
      const place = framed(Vector.times(aside, radius), [0, 0, radius], Vector.times(axis, size), at);
      this.put(mesh, place, [...rgb(color), alpha]);
    };
    part(this.cylinder, 0.022, length - head, from);
    part(this.cone, 0.06, head, Vector.plus(from, axis, length - head));
  }

  drawFlat({ position, radius, ring, color }) {
    if (!ring) return this.put(this.cylinder, upright(radius, 0.004, position), color, PLAIN);
    const angles = Array.from({ length: 181 }, (_, i) => (Math.PI * i) / 90);
    const points = angles.map((a) => Vector.plus(position, [Math.cos(a), Math.sin(a)], radius));
    this.drawBand(points, rgb(color), 0.16);
  }

  drawBand(points, color, dash) {
    const gl = this.gl;
    const corners = new Float32Array(Mesh.band(points, 0.035, dash));
    gl.bindBuffer(gl.ARRAY_BUFFER, this.strip.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, corners, gl.DYNAMIC_DRAW);
    this.put({ ...this.strip, count: corners.length / 6 }, upright(1, 1, [0, 0], 0.006), [...color, 1], DASHED);
  }

  /** What is solid, flattened on the floor along the light; each pixel is darkened once. */
  drawShadows(robots, posts) {
    const { gl, at } = this;
    const [lx, ly, lz] = LIGHT;
    const flattened = new DOMMatrix([1, 0, 0, 0, 0, 1, 0, 0, -lx / lz, -ly / lz, 0, 0, 0, 0, 0.008, 1]);
    this.isShadow = true;
    gl.enable(gl.BLEND);
    gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.EQUAL, 0, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    gl.uniformMatrix4fv(at.camera, false, this.matrix.multiply(flattened).toFloat32Array());
    for (const robot of robots) this.drawRobot(robot);
    for (const post of posts) this.drawPost(post);
    gl.uniformMatrix4fv(at.camera, false, this.matrix.toFloat32Array());
    gl.disable(gl.STENCIL_TEST);
    gl.disable(gl.BLEND);
    this.isShadow = false;
  }
}
