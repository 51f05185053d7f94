// Draws ballbots with WebGL 2: a floor, robots and translucent ghosts with shadows, markers, paths and arrows. What it draws is
// described as in drawing.py. No library: the ones that draw in 3D are larger than all the rest of the page.
"use strict";

const FIELD_OF_VIEW = 0.7; // rad, vertical
const LIGHT = [-0.36, -0.44, 0.82]; // towards it, of length 1
/** Colours of sky, bright and dark squares. */
const THEMES = {
  light: { sky: [0.933, 0.949, 0.973], bright: [0.985, 0.985, 0.985], dim: [0.83, 0.86, 0.905] },
  dark: { sky: [0.075, 0.09, 0.12], bright: [0.27, 0.3, 0.35], dim: [0.2, 0.225, 0.27] },
};

const SOLID_VERTEX = `#version 300 es
in vec3 position; in vec3 normal;
uniform mat4 place, camera;
out vec3 at, up;
void main() {
  vec4 world = place * vec4(position, 1.0);
  at = world.xyz; up = mat3(place) * normal;
  gl_Position = camera * world;
}`;
const SOLID_FRAGMENT = `#version 300 es
precision highp float;
in vec3 at, up;
uniform vec4 color; uniform vec3 eye, light; uniform float lit;
out vec4 pixel;
void main() {
  vec3 n = normalize(up), e = normalize(eye - at);
  float diffuse = max(dot(n, light), 0.0);
  float shine = pow(max(dot(n, normalize(light + e)), 0.0), 40.0);
  vec3 shaded = color.rgb * (0.52 + 0.16 * n.z + 0.5 * diffuse) + 0.22 * shine;
  pixel = vec4(lit > 0.5 ? shaded : color.rgb, color.a); // a flattened body has no normals, so nothing is mixed
}`;
const FLOOR_FRAGMENT = `#version 300 es
precision highp float;
in vec3 at, up;
uniform vec3 eye, sky, bright, dim; uniform vec4 color; uniform vec3 light; uniform float lit;
out vec4 pixel;
void main() {
  vec2 wide = max(fwidth(at.xy), 1e-4), p = at.xy;
  // the share of dark squares in the pixel, so that far squares do not flicker
  vec2 wave = 2.0 * (abs(fract((p - 0.5 * wide) * 0.5) - 0.5) - abs(fract((p + 0.5 * wide) * 0.5) - 0.5)) / wide;
  float dark = 0.5 - 0.5 * wave.x * wave.y;
  float far = smoothstep(5.0, 26.0, distance(at.xy, eye.xy));
  pixel = vec4(mix(mix(bright, dim, dark), sky, far), 1.0);
}`;

/** 4×4 matrices as arrays in columns. */
const Matrix = {
  times(a, b) {
    const c = new Array(16).fill(0);
    for (let i = 0; i < 4; i++) for (let j = 0; j < 4; j++) for (let k = 0; k < 4; k++) c[4 * j + i] += a[4 * k + i] * b[4 * j + k];
    return c;
  },
  perspective(angle, aspect, near, far) {
    const f = 1 / Math.tan(angle / 2);
    return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0];
  },
  /** From axes and origin. */
  frame: (x, y, z, at) => [...x, 0, ...y, 0, ...z, 0, ...at, 1],
  apply: (m, p) => [0, 1, 2, 3].map((i) => m[i] * p[0] + m[4 + i] * p[1] + m[8 + i] * p[2] + m[12 + i]),
};

const Vector = {
  minus: (a, b) => a.map((v, i) => v - b[i]),
  plus: (a, b, scale = 1) => a.map((v, i) => v + scale * b[i]),
  times: (a, s) => a.map((v) => v * s),
  dot: (a, b) => a.reduce((sum, v, i) => sum + v * b[i], 0),
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
  cylinder: () => [
    ...Mesh.turned([[0, 0, 0, -1], [1, 0, 0, -1]]),
    ...Mesh.turned([[1, 0, 1, 0], [1, 1, 1, 0]]),
    ...Mesh.turned([[1, 1, 0, 1], [0, 1, 0, 1]]),
  ],
  cone: () => [...Mesh.turned([[0, 0, 0, -1], [1, 0, 0, -1]]), ...Mesh.turned([[1, 0, 0.7, 0.7], [0, 1, 0.7, 0.7]])],
  square: () => [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]].flatMap(([x, y]) => [x, y, 0, 0, 0, 1]),
  /** A band along points (x, y), dashed if `dash` > 0, m. */
  band(points, width, dash = 0) {
    const out = [];
    let along = 0; // m, how far the line has come
    for (let i = 0; i + 1 < points.length; i++) {
      const [a, b] = [points[i], points[i + 1]];
      const way = [b[0] - a[0], b[1] - a[1]];
      const length = Math.hypot(...way);
      if (length < 1e-9) continue;
      const side = [-way[1], way[0]].map((part) => (0.5 * width * part) / length);
      const piece = (from, to) => {
        const at = (share, sign) => [a[0] + share * way[0] + sign * side[0], a[1] + share * way[1] + sign * side[1], 0, 0, 0, 1];
        const [p, q, r, s] = [at(from, -1), at(from, 1), at(to, 1), at(to, -1)];
        out.push(...p, ...s, ...r, ...p, ...r, ...q);
      };
      if (!dash) piece(0, 1);
      for (let n = Math.floor(along / dash); dash && n * dash < along + length; n++) {
        if (n % 2 === 0) piece(Math.max((n * dash - along) / length, 0), Math.min(((n + 1) * dash - along) / length, 1));
      }
      along += length;
    }
    return out;
  },
};

function rgb(color) {
  return [1, 3, 5].map((i) => parseInt(color.slice(i, i + 2), 16) / 255);
}

/** The body's axis in state x, upwards, and the axes across it. γ turns about y, then θ about the turned −x. */
function bodyFrame(x) {
  const [sg, cg, st, ct] = [Math.sin(x[2]), Math.cos(x[2]), Math.sin(x[3]), Math.cos(x[3])];
  return [[cg, 0, -sg], [-sg * st, ct, -cg * st], [sg * ct, st, cg * ct]];
}

class Scene {
  /** Throws where the browser has no WebGL 2. */
  constructor(canvas, robot, look) {
    this.canvas = canvas;
    this.robot = robot;
    this.look = look;
    this.theme = THEMES.light;
    const gl = (this.gl = canvas.getContext("webgl2", { alpha: false, antialias: true, stencil: true }));
    if (!gl) throw new Error("no WebGL 2");
    this.solid = this.program(SOLID_VERTEX, SOLID_FRAGMENT);
    this.floor = this.program(SOLID_VERTEX, FLOOR_FRAGMENT);
    this.meshes = {};
    for (const name of ["sphere", "cylinder", "cone", "square"]) this.meshes[name] = this.mesh(Mesh[name](), gl.STATIC_DRAW);
    this.strip = this.mesh([], gl.DYNAMIC_DRAW);
    this.camera = { yaw: -2.2, pitch: 0.34, distance: 3.6, target: [0, 0, 0.5] };
  }

  program(vertex, fragment) {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "position");
    gl.bindAttribLocation(program, 1, "normal");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const names = ["place", "camera", "color", "eye", "light", "lit", "sky", "bright", "dim"];
    return { program, at: Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)])) };
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

  /** Fits the drawing buffer to the canvas, and computes where the camera is. */
  aim() {
    const { canvas, gl } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio].map((v) => Math.max(1, Math.round(v)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    const { yaw, pitch, distance, target } = this.camera;
    const back = [Math.cos(yaw) * Math.cos(pitch), Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch)];
    this.eye = Vector.plus(target, back, distance);
    this.right = Vector.unit(Vector.cross([0, 0, 1], back));
    this.up = Vector.cross(back, this.right);
    this.back = back;
    const [r, u, b, e] = [this.right, this.up, back, this.eye];
    const view = [
      r[0], u[0], b[0], 0, r[1], u[1], b[1], 0, r[2], u[2], b[2], 0,
      -Vector.dot(r, e), -Vector.dot(u, e), -Vector.dot(b, e), 1,
    ];
    this.matrix = Matrix.times(Matrix.perspective(FIELD_OF_VIEW, width / height, 0.1, 200), view);
  }

  /** Where a point (3,), m, is on the canvas, CSS pixels; null behind the camera. */
  project(point) {
    const [x, y, , w] = Matrix.apply(this.matrix, point);
    if (w <= 0.05) return null;
    return [((1 + x / w) / 2) * this.canvas.clientWidth, ((1 - y / w) / 2) * this.canvas.clientHeight];
  }

  /** The point at height z, m, that a pixel of the canvas shows; null above the horizon. */
  unproject([px, py], z) {
    const { clientWidth, clientHeight } = this.canvas;
    const reach = Math.tan(FIELD_OF_VIEW / 2);
    const across = reach * (clientWidth / clientHeight) * ((2 * px) / clientWidth - 1);
    const along = reach * (1 - (2 * py) / clientHeight);
    const ray = Vector.plus(Vector.plus(Vector.times(this.back, -1), this.right, across), this.up, along);
    const t = (z - this.eye[2]) / ray[2];
    return t > 0 && t < 60 ? Vector.plus(this.eye, ray, t) : null;
  }

  /** A drawing: robots {x, color, u, alpha, push}, ghosts first, paths {points, color, dashed} and markers. */
  draw({ robots, paths, markers }) {
    const gl = this.gl;
    this.aim();
    gl.clearColor(...this.theme.sky, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    this.use(this.floor);
    const [tx, ty] = this.camera.target;
    this.put("square", Matrix.frame([60, 0, 0], [0, 60, 0], [0, 0, 1], [tx, ty, 0]), [1, 1, 1, 1]);
    this.use(this.solid);
    gl.depthMask(false);
    for (const marker of markers) if (marker.height < 0.1) this.drawFlat(marker);
    for (const path of paths) this.drawBand(path.points, rgb(path.color), path.dashed ? 0.09 : 0);
    this.drawShadows(robots, markers);
    gl.depthMask(true);
    for (const marker of markers) {
      if (marker.height < 0.1) continue;
      const { position, radius, height, color } = marker;
      this.put("cylinder", Matrix.frame([radius, 0, 0], [0, radius, 0], [0, 0, height], [...position, 0]), color);
    }
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

  use({ program, at }) {
    const gl = this.gl;
    this.at = at;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.camera, false, this.matrix);
    gl.uniform3fv(at.eye, this.eye);
    gl.uniform3fv(at.light, LIGHT);
    for (const [name, value] of Object.entries(this.theme)) gl.uniform3fv(at[name], value);
    gl.uniform1f(at.lit, 1);
  }

  put(mesh, place, color) {
    const gl = this.gl;
    const { array, count } = typeof mesh === "string" ? this.meshes[mesh] : mesh;
    gl.bindVertexArray(array);
    gl.uniformMatrix4fv(this.at.place, false, this.shadow ? Matrix.times(this.shadow, place) : place);
    if (!this.shadow) gl.uniform4fv(this.at.color, color);
    gl.drawArrays(gl.TRIANGLES, 0, count);
  }

  drawRobot({ x, color, u, alpha, push }) {
    const { ball_radius, body_radius, body_length, com_height } = this.robot;
    const ball = [x[0], x[1], ball_radius];
    this.put("sphere", Matrix.frame([ball_radius, 0, 0], [0, ball_radius, 0], [0, 0, ball_radius], ball), [...rgb(this.look.colors.ball), alpha]);
    const [a, b, axis] = bodyFrame(x);
    const low = Vector.plus(ball, axis, com_height - body_length / 2);
    const place = Matrix.frame(Vector.times(a, body_radius), Vector.times(b, body_radius), Vector.times(axis, body_length), low);
    this.put("cylinder", place, [...rgb(color), alpha]);
    if (this.shadow) return;
    if (u && Math.hypot(...u) > this.look.least_force) this.drawArrow(ball, Vector.times([...u, 0], this.look.force_scale), this.look.colors.force, alpha);
    if (push) this.drawArrow(Vector.plus(ball, axis, com_height), [...push, 0], this.look.colors.push, alpha);
  }

  /** An arrow from a point along a vector, m. */
  drawArrow(from, vector, color, alpha) {
    const length = Math.hypot(...vector);
    if (length < 1e-3) return;
    const head = Math.min(0.16, length);
    const axis = Vector.times(vector, 1 / length);
    const across = Vector.unit(Vector.cross(axis, Math.abs(axis[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0]));
    const aside = Vector.cross(axis, across);
    const part = (mesh, radius, size, at) => {
      const axes = [Vector.times(across, radius), Vector.times(aside, radius), Vector.times(axis, size)];
      this.put(mesh, Matrix.frame(...axes, at), [...rgb(color), alpha]);
    };
    part("cylinder", 0.022, length - head, from);
    part("cone", 0.06, head, Vector.plus(from, axis, length - head));
  }

  drawFlat({ position, radius, ring, color }) {
    if (!ring) {
      this.gl.uniform1f(this.at.lit, 0);
      this.put("cylinder", Matrix.frame([radius, 0, 0], [0, radius, 0], [0, 0, 0.004], [...position, 0]), color);
      this.gl.uniform1f(this.at.lit, 1);
      return;
    }
    const points = Array.from({ length: 181 }, (_, i) => (Math.PI * i) / 90).map((a) => [
      position[0] + radius * Math.cos(a),
      position[1] + radius * Math.sin(a),
    ]);
    this.drawBand(points, color.slice(0, 3), 0.16);
  }

  drawBand(points, color, dash) {
    const gl = this.gl;
    const corners = new Float32Array(Mesh.band(points, 0.035, dash));
    gl.bindVertexArray(this.strip.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.strip.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, corners, gl.DYNAMIC_DRAW);
    this.strip.count = corners.length / 6;
    gl.uniform1f(this.at.lit, 0);
    this.put(this.strip, Matrix.frame([1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0.006]), [...color, 1]);
    gl.uniform1f(this.at.lit, 1);
  }

  /** What is solid, flattened on the floor along the light; each pixel is darkened once. */
  drawShadows(robots, markers) {
    const gl = this.gl;
    const [lx, ly, lz] = LIGHT;
    this.shadow = [1, 0, 0, 0, 0, 1, 0, 0, -lx / lz, -ly / lz, 0, 0, 0, 0, 0.008, 1];
    gl.enable(gl.BLEND);
    gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.EQUAL, 0, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    gl.uniform4f(this.at.color, 0.1, 0.13, 0.2, 0.2);
    gl.uniform1f(this.at.lit, 0);
    for (const robot of robots) this.drawRobot(robot);
    for (const { position, radius, height } of markers) {
      if (height >= 0.1) this.put("cylinder", Matrix.frame([radius, 0, 0], [0, radius, 0], [0, 0, height], [...position, 0]));
    }
    gl.uniform1f(this.at.lit, 1);
    gl.disable(gl.STENCIL_TEST);
    gl.disable(gl.BLEND);
    this.shadow = null;
  }
}
