// SPDX-License-Identifier: Apache-2.0
// A small WebGL 2 renderer: lit solids by instances, points, lines; drawn when something has changed. z is up, metres.

import { boxMesh, cylinderMesh, sphereMesh } from "./meshes.js";
import { cross, lookAt, multiply, perspective, project, unit } from "./matrix.js";

const SOLID = [
  `#version 300 es
  layout(location = 0) in vec3 position;
  layout(location = 1) in vec3 normal;
  layout(location = 2) in mat4 model;
  layout(location = 6) in vec4 color;
  uniform mat4 camera;
  out vec3 n, p;
  out vec4 c;
  void main() {
    vec4 world = model * vec4(position, 1.0);
    mat3 m = mat3(model);
    // Shapes are scaled along their own axes, so this is the inverse transpose.
    n = m * (normal / vec3(dot(m[0], m[0]), dot(m[1], m[1]), dot(m[2], m[2])));
    p = world.xyz;
    c = color;
    gl_Position = camera * world;
  }`,
  `#version 300 es
  precision highp float;
  in vec3 n, p;
  in vec4 c;
  uniform vec3 eye, sky, ground;
  out vec4 color;
  void main() {
    vec3 normal = normalize(n), view = normalize(eye - p);
    const vec3 key = vec3(0.43, -0.52, 0.74);
    vec3 light = mix(ground, sky, 0.5 + 0.5 * normal.z) + 0.55 * max(dot(normal, key), 0.0);
    float shine = pow(max(dot(normal, normalize(key + view)), 0.0), 40.0);
    float rim = pow(1.0 - max(dot(normal, view), 0.0), 3.0);
    color = vec4(c.rgb * light + 0.10 * shine + 0.09 * rim * sky, c.a);
  }`,
];
const DOTS = [
  `#version 300 es
  layout(location = 0) in vec3 position;
  layout(location = 1) in vec4 color;
  uniform mat4 camera;
  uniform float pixels;
  out vec4 c;
  void main() {
    gl_Position = camera * vec4(position, 1.0);
    gl_PointSize = clamp(pixels / gl_Position.w, 1.5, 16.0);
    c = color;
  }`,
  `#version 300 es
  precision mediump float;
  in vec4 c;
  out vec4 color;
  void main() { color = c; }`,
];
const FOVY = 0.7;
const START = { target: [0.3, 0.0, 0.42], azimuth: -0.85, elevation: 0.5, distance: 1.75 };
/** Numbers of an instance: its matrix and its colour. */
export const INSTANCE = 20;

export class Scene {
  /** @param canvas where it is drawn  @param onDrawn called after each picture */
  constructor(canvas, onDrawn) {
    this.canvas = canvas;
    this.onDrawn = onDrawn;
    this.gl = canvas.getContext("webgl2", { antialias: true, alpha: false, powerPreference: "low-power" });
    if (!this.gl) throw new Error("this browser draws no WebGL 2");
    this.solid = this.#program(...SOLID);
    this.dots = this.#program(...DOTS);
    this.meshes = { box: this.#buffer(boxMesh()), cylinder: this.#buffer(cylinderMesh()), sphere: this.#buffer(sphereMesh()) };
    this.groups = new Map();
    this.orbit = structuredClone(START);
    this.theme = { background: [0, 0, 0], sky: [1, 1, 1], ground: [0.5, 0.5, 0.5] };
    this.dirty = false;
    new ResizeObserver(() => this.redraw()).observe(canvas);
    this.#listen();
  }

  /** Solids of one shape; `data` has INSTANCE numbers each. Nothing hides behind the see-through ones. */
  setSolids(name, mesh, data, { glass = false } = {}) {
    this.#set(name, { kind: "solid", mesh, glass, count: data.length / INSTANCE }, [data]);
  }

  /** Points with an edge (m) and colours of `size` bytes each. */
  setPoints(name, positions, colors, size, edge) {
    this.#set(name, { kind: "points", size, edge, count: positions.length / 3 }, [positions, colors]);
  }

  /** Pairs of points, and a colour of four bytes for each point. */
  setLines(name, positions, colors) {
    this.#set(name, { kind: "lines", size: 4, edge: 0, count: positions.length / 3 }, [positions, colors]);
  }

  remove(name) {
    const group = this.groups.get(name);
    if (!group) return;
    group.buffers.forEach((buffer) => this.gl.deleteBuffer(buffer));
    this.gl.deleteVertexArray(group.array);
    this.groups.delete(name);
    this.redraw();
  }

  redraw() {
    if (this.dirty) return;
    this.dirty = true;
    requestAnimationFrame(() => {
      this.dirty = false;
      this.#draw();
      this.onDrawn();
    });
  }

  /** Where a point is on the canvas, CSS pixels; null behind the eye. */
  onScreen(point) {
    const at = this.camera && project(this.camera, point);
    return at && [((at[0] + 1) / 2) * this.canvas.clientWidth, ((1 - at[1]) / 2) * this.canvas.clientHeight];
  }

  #set(name, group, arrays) {
    const gl = this.gl;
    const before = this.groups.get(name);
    const same = before && before.mesh === group.mesh && before.kind === group.kind;
    if (before && !same) this.remove(name);
    const kept = same ? before : { array: gl.createVertexArray(), buffers: arrays.map(() => gl.createBuffer()) };
    arrays.forEach((data, i) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, kept.buffers[i]);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    });
    this.groups.set(name, { ...group, array: kept.array, buffers: kept.buffers });
    if (!same) this.#layout(this.groups.get(name));
    this.redraw();
  }

  #layout(group) {
    const gl = this.gl;
    const attribute = (at, size, type, stride, offset, divisor = 0) => {
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, size, type, type === gl.UNSIGNED_BYTE, stride, offset);
      gl.vertexAttribDivisor(at, divisor);
    };
    gl.bindVertexArray(group.array);
    if (group.kind === "solid") {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.meshes[group.mesh].buffer);
      attribute(0, 3, gl.FLOAT, 24, 0);
      attribute(1, 3, gl.FLOAT, 24, 12);
      gl.bindBuffer(gl.ARRAY_BUFFER, group.buffers[0]);
      for (let i = 0; i < 5; i++) attribute(2 + i, 4, gl.FLOAT, 4 * INSTANCE, 16 * i, 1);
    } else {
      gl.bindBuffer(gl.ARRAY_BUFFER, group.buffers[0]);
      attribute(0, 3, gl.FLOAT, 12, 0);
      gl.bindBuffer(gl.ARRAY_BUFFER, group.buffers[1]);
      attribute(1, group.size, gl.UNSIGNED_BYTE, group.size, 0);
    }
    gl.bindVertexArray(null);
  }

  #draw() {
    const { gl, canvas, theme, orbit } = this;
    const density = Math.min(window.devicePixelRatio, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((v) => Math.max(1, Math.round(v * density)));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const eye = this.#eye();
    const lens = perspective(FOVY, width / height, 0.02, 30);
    this.camera = multiply(lens, lookAt(eye, orbit.target, [0, 0, 1]));
    gl.viewport(0, 0, width, height);
    gl.clearColor(...theme.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    const groups = [...this.groups.values()];
    this.#use(this.solid, { eye, sky: theme.sky, ground: theme.ground });
    groups.filter((g) => g.kind === "solid" && !g.glass).forEach((g) => this.#solids(g));
    this.#use(this.dots, {});
    gl.enable(gl.BLEND);
    for (const group of groups.filter((g) => g.kind !== "solid")) {
      gl.uniform1f(this.dots.at.pixels, (group.edge * height) / (2 * Math.tan(FOVY / 2)));
      gl.bindVertexArray(group.array);
      gl.drawArrays(group.kind === "points" ? gl.POINTS : gl.LINES, 0, group.count);
    }
    gl.depthMask(false);
    this.#use(this.solid, { eye, sky: theme.sky, ground: theme.ground });
    groups.filter((g) => g.glass).forEach((g) => this.#solids(g));
    gl.depthMask(true);
    gl.disable(gl.BLEND);
    gl.bindVertexArray(null);
  }

  #solids(group) {
    this.gl.bindVertexArray(group.array);
    this.gl.drawArraysInstanced(this.gl.TRIANGLES, 0, this.meshes[group.mesh].corners, group.count);
  }

  #use(program, vectors) {
    this.gl.useProgram(program.program);
    this.gl.uniformMatrix4fv(program.at.camera, false, this.camera);
    for (const [name, value] of Object.entries(vectors)) this.gl.uniform3fv(program.at[name], value);
  }

  #program(vertex, fragment) {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const names = ["camera", "eye", "sky", "ground", "pixels"];
    return { program, at: Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)])) };
  }

  #buffer(corners) {
    const buffer = this.gl.createBuffer();
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, buffer);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, corners, this.gl.STATIC_DRAW);
    return { buffer, corners: corners.length / 6 };
  }

  #eye() {
    const { target, azimuth, elevation, distance } = this.orbit;
    const flat = Math.cos(elevation) * distance;
    return [target[0] + flat * Math.cos(azimuth), target[1] + flat * Math.sin(azimuth), target[2] + distance * Math.sin(elevation)];
  }

  #turn(dx, dy) {
    this.orbit.azimuth -= dx * 0.006;
    this.orbit.elevation = Math.min(1.55, Math.max(-0.4, this.orbit.elevation + dy * 0.006));
  }

  #move(dx, dy) {
    const forward = unit(this.orbit.target.map((v, i) => v - this.#eye()[i]));
    const right = unit(cross(forward, [0, 0, 1]));
    const up = cross(right, forward);
    const scale = (2 * Math.tan(FOVY / 2) * this.orbit.distance) / this.canvas.clientHeight;
    this.orbit.target = this.orbit.target.map((v, i) => v + scale * (-dx * right[i] + dy * up[i]));
  }

  #zoom(factor) {
    this.orbit.distance = Math.min(6, Math.max(0.25, this.orbit.distance * factor));
  }

  #listen() {
    const canvas = this.canvas;
    const change = (work) => (event) => {
      event.preventDefault();
      work(event);
      this.redraw();
    };
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      const move = event.buttons & 6 || event.shiftKey;
      change(() => (move ? this.#move(event.movementX, event.movementY) : this.#turn(event.movementX, event.movementY)))(event);
    });
    canvas.addEventListener("wheel", change((event) => this.#zoom(Math.exp(event.deltaY * 0.001))), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("dblclick", change(() => (this.orbit = structuredClone(START))));
    const keys = {
      ArrowLeft: () => this.#turn(-20, 0), ArrowRight: () => this.#turn(20, 0), ArrowUp: () => this.#turn(0, 20),
      ArrowDown: () => this.#turn(0, -20), "+": () => this.#zoom(0.9), "-": () => this.#zoom(1.1),
    };
    canvas.addEventListener("keydown", (event) => keys[event.key] && change(keys[event.key])(event));
  }
}
