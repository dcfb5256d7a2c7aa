// SPDX-License-Identifier: Apache-2.0
// The 3-D scene, by three.js: solids, points and lines in named layers, drawn when something has changed. z is up, metres.
// Poses are 4×4 matrices as arrays of 16 numbers by columns; colours are arrays of three numbers from 0 to 1.

import * as THREE from "./vendor/three.module.min.js";
import { OrbitControls } from "./vendor/OrbitControls.js";

THREE.ColorManagement.enabled = false; // colours are shown as they are given
const FOVY = 0.7;
const START = { eye: [1.314, -1.154, 1.259], target: [0.3, 0, 0.42] };
const WORK = new THREE.Box3(new THREE.Vector3(0.1, -0.35, 0.3), new THREE.Vector3(0.7, 0.35, 0.6)); // in view with the robot
const SHAPES = {
  box: new THREE.BoxGeometry(),
  cylinder: new THREE.CylinderGeometry(0.5, 0.5, 1, 28).rotateX(Math.PI / 2),
  sphere: new THREE.SphereGeometry(0.5, 28, 14),
};
const EDGES = new THREE.EdgesGeometry(SHAPES.box);
const SHARED = new Set([...Object.values(SHAPES), EDGES]);

/** A solid's material; nothing hides behind a see-through one. */
function shiny(color, opacity = 1) {
  const glass = opacity < 1;
  const look = { specular: 0x0a0a0a, shininess: 40, opacity, transparent: glass, depthWrite: !glass };
  return new THREE.MeshPhongMaterial({ color: new THREE.Color(...color), ...look });
}

function geometry(attributes) {
  const made = new THREE.BufferGeometry();
  for (const [name, [data, size]] of Object.entries(attributes)) {
    made.setAttribute(name, new THREE.BufferAttribute(data, size, data instanceof Uint8Array));
  }
  return made;
}

export function place(object, pose, [x, y, z] = [1, 1, 1]) {
  object.matrixAutoUpdate = false;
  object.matrix.fromArray(pose).scale(new THREE.Vector3(x, y, z));
  object.matrixWorldNeedsUpdate = true;
  return object;
}

/** What moves as one. */
export function group(...objects) {
  const made = new THREE.Group();
  objects.forEach((object) => made.add(object));
  return made;
}

/** A box, cylinder or sphere whose size is that of the shape's bounding box. */
export function solid(shape, pose, size, color, opacity) {
  return place(new THREE.Mesh(SHAPES[shape], shiny(color, opacity)), pose, size);
}

/** Triangles, nine numbers each. */
export function facets(corners) {
  const made = geometry({ position: [corners, 3] });
  made.computeVertexNormals();
  return made;
}

/** A mesh of `facets`; a scale that mirrors turns the triangles inside out, so both sides are drawn. */
export function faceted(shape, pose, scale, color) {
  const look = shiny(color);
  look.side = THREE.DoubleSide;
  return place(new THREE.Mesh(shape, look), pose, scale);
}

export function boxEdges(pose, size, color) {
  return place(new THREE.LineSegments(EDGES, new THREE.LineBasicMaterial({ color: new THREE.Color(...color) })), pose, size);
}

/** Cubes from four numbers each, centre and edge; `paint` gives the colour at a height. */
export function cubes(cells, paint) {
  const made = new THREE.InstancedMesh(SHAPES.box, shiny([1, 1, 1]), cells.length / 4);
  const [pose, color] = [new THREE.Matrix4(), new THREE.Color()];
  for (let i = 0; i < made.count; i++) {
    const [x, y, z, edge] = cells.subarray(4 * i, 4 * i + 4);
    made.setMatrixAt(i, pose.makeScale(0.94 * edge, 0.94 * edge, 0.94 * edge).setPosition(x, y, z));
    made.setColorAt(i, color.setRGB(...paint(z)));
  }
  return made;
}

/** Points of an edge length, with colours of three bytes each. */
export function points(positions, colors, edge) {
  const size = edge / Math.tan(FOVY / 2); // three.js leaves the field of view out
  return new THREE.Points(geometry({ position: [positions, 3], color: [colors, 3] }), new THREE.PointsMaterial({ size, vertexColors: true }));
}

/** Pairs of points, in order, with a colour of four bytes for each point. */
export function lines(ends, colors) {
  const shape = geometry({ position: [new Float32Array(ends.flat()), 3], color: [new Uint8Array(colors.flat()), 4] });
  return new THREE.LineSegments(shape, new THREE.LineBasicMaterial({ vertexColors: true, transparent: true }));
}

export class Scene {
  /** @param canvas where it is drawn  @param onDrawn called after each picture */
  constructor(canvas, onDrawn) {
    this.canvas = canvas;
    this.onDrawn = onDrawn;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, powerPreference: "low-power" });
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.camera = new THREE.PerspectiveCamera(THREE.MathUtils.radToDeg(FOVY), 1, 0.02, 30);
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(...START.eye);
    this.scene = new THREE.Scene();
    this.sky = new THREE.HemisphereLight(0, 0, Math.PI);
    this.sky.position.set(0, 0, 1);
    const sun = new THREE.DirectionalLight(0xffffff, 0.55 * Math.PI);
    sun.position.set(0.43, -0.52, 0.74);
    this.scene.add(this.sky, sun);
    this.layers = new Map();
    this.waiting = false;
    this.#steer();
    new ResizeObserver(() => this.#resize()).observe(canvas);
  }

  /** Colours of the background, and of the light from above and from below. */
  setTheme({ background, sky, ground }) {
    this.scene.background = new THREE.Color(...background);
    this.sky.color.setRGB(...sky);
    this.sky.groundColor.setRGB(...ground);
    this.redraw();
  }

  /** Put these objects in place of those that the layer had. */
  set(layer, ...objects) {
    this.remove(layer);
    this.layers.set(layer, group(...objects));
    this.scene.add(this.layers.get(layer));
    this.redraw();
  }

  remove(layer) {
    this.layers.get(layer)?.traverse((object) => {
      if (object.geometry && !SHARED.has(object.geometry)) object.geometry.dispose();
      object.material?.dispose();
      object.dispose?.();
    });
    this.layers.get(layer)?.removeFromParent();
    this.layers.delete(layer);
    this.redraw();
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.renderer.render(this.scene, this.camera);
      this.onDrawn();
    });
  }

  /** Look at all of a layer and the work space in front of it, from the direction of the start. */
  frame(layer) {
    const { center, radius } = new THREE.Box3().setFromObject(this.layers.get(layer)).union(WORK).getBoundingSphere(new THREE.Sphere());
    const across = Math.min(1, this.camera.aspect) * Math.tan(FOVY / 2);
    const back = new THREE.Vector3(...START.eye).sub(new THREE.Vector3(...START.target)).normalize();
    this.controls.target.copy(center);
    this.camera.position.copy(center).addScaledVector(back, (0.8 * radius) / Math.sin(Math.atan(across)));
    this.controls.update();
    this.controls.saveState();
  }

  /** Where a point is on the canvas, CSS pixels; null behind the eye. */
  onScreen(point) {
    const { x, y, z } = new THREE.Vector3(...point).project(this.camera);
    return z < 1 ? [((x + 1) / 2) * this.canvas.clientWidth, ((1 - y) / 2) * this.canvas.clientHeight] : null;
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(Math.max(1, width), Math.max(1, height), false);
    this.camera.aspect = Math.max(1, width) / Math.max(1, height);
    this.camera.updateProjectionMatrix();
    this.redraw();
  }

  #steer() {
    const controls = (this.controls = new OrbitControls(this.camera, this.canvas));
    const { ROTATE, PAN } = THREE.MOUSE;
    Object.assign(controls, {
      rotateSpeed: 0.8, zoomSpeed: 2, minDistance: 0.25, maxDistance: 6, minPolarAngle: 0.02, maxPolarAngle: 1.97,
      mouseButtons: { LEFT: ROTATE, MIDDLE: PAN, RIGHT: PAN },
    });
    controls.target.set(...START.target);
    controls.update();
    controls.addEventListener("change", () => this.redraw());
    this.canvas.addEventListener("dblclick", () => controls.reset());
    const keys = {
      ArrowLeft: () => controls.rotateLeft(-0.12), ArrowRight: () => controls.rotateLeft(0.12),
      ArrowUp: () => controls.rotateUp(0.12), ArrowDown: () => controls.rotateUp(-0.12),
      "+": () => controls.dollyIn(0.9), "-": () => controls.dollyOut(0.9),
    };
    this.canvas.addEventListener("keydown", (event) => {
      if (!(event.key in keys)) return;
      event.preventDefault();
      keys[event.key]();
    });
  }
}
