// SPDX-License-Identifier: Apache-2.0
// The page: data of the wanted layers come by a websocket, scene and panel show them, requests go to the server.

import { AskPanel, GraspPanel, HealthPanel, StopPanel, element } from "./panel.js";
import { Scene, boxEdges, cubes, faceted, facets, group, lines, place, points, solid } from "./scene.js";

const $ = (id) => document.getElementById(id);
const token = takeToken();

const LAYERS = { detections: "Objects", cloud: "Cloud", map: "Map", plan: "Plan" };
const wanted = new Set(["robot", "detections", "cloud", "plan"]);
const scene = new Scene($("scene"), placeLabels);
const grasp = new GraspPanel(ask);
const asking = new AskPanel(ask, markChosen);
const health = new HealthPanel();
const stopping = new StopPanel(ask);

let socket = null;
let links = new Map(); // of the robot, with what hangs on them
let held = [];
let boxes = [];
let meshes = [];
let complete = false; // the robot with its meshes
let framed = false; // once: a graph that starts again leaves the view where it is

const handlers = {
  hello(message) {
    showRobot(message.robot);
    grasp.setStates(message.states);
    if (!$("cameras").children.length) {
      makeCameras(message.cameras, message.for_people);
      makeArms(message.arms);
    }
    drawFloor();
    want();
  },
  meshes(head, body) {
    showMeshes(head.counts, body);
  },
  robot(_, body) {
    [...links.values()].forEach((link, i) => place(link, new Float32Array(body, 64 * i, 16)).visible = true);
    if (complete && !framed) {
      scene.frame("robot");
      framed = true;
    }
    scene.redraw();
  },
  held(message) {
    held.forEach((box) => box.removeFromParent());
    held = message.boxes.filter((box) => links.has(box.link)).map((box) => {
      const made = solid("box", box.pose, box.size, GLASS, 0.45);
      links.get(box.link).add(made);
      return made;
    });
    scene.redraw();
  },
  cloud(head, body) {
    const colors = new Uint8Array(body, 12 * head.count);
    scene.set("cloud", points(new Float32Array(body, 0, 3 * head.count), colors, 0.011));
  },
  map(_, body) {
    scene.set("map", cubes(new Float32Array(body), heightColor));
  },
  detections(message) {
    boxes = message.boxes;
    drawDetections();
    asking.setDetections(boxes);
  },
  plan(message) {
    const ends = message.ways.flatMap((way) => way.slice(1).flatMap((point, i) => [way[i], point]));
    scene.set("plan", lines(ends, ends.map(() => [224, 138, 40, 255])));
  },
  image(head, body) {
    const image = document.querySelector(`#cameras figure[data-camera="${CSS.escape(head.camera)}"] img`);
    const old = image.src;
    image.src = URL.createObjectURL(new Blob([body], { type: "image/jpeg" }));
    if (old) URL.revokeObjectURL(old);
  },
  grasp: (message) => grasp.show(message),
  health(message) {
    health.show(message);
    stopping.show(message);
  },
  outcome: (message) => asking.showOutcome(message),
  fault: showFault,
};

// The token comes after the # of the address: no server, Referer or log gets it. This tab keeps it for a reload, and it
// does not stay in the address bar or the history.
function takeToken() {
  if (location.hash.length > 1) {
    sessionStorage.setItem("token", location.hash.slice(1));
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem("token") ?? "";
}

// --- the line to the server
function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket?token=${encodeURIComponent(token)}`);
  socket.binaryType = "arraybuffer";
  socket.addEventListener("open", () => showLink("ok", "connected"));
  socket.addEventListener("message", ({ data }) => receive(data));
  socket.addEventListener("close", () => {
    showLink("error", "not connected");
    setTimeout(connect, 1500);
  });
}

function receive(data) {
  if (typeof data === "string") {
    show(JSON.parse(data));
    return;
  }
  const length = new DataView(data).getUint32(0, true);
  show(JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length))), data.slice(4 + length));
}

function show(head, body) {
  const layer = head.kind === "fault" ? head.layer : head.kind === "image" ? `image:${head.camera}` : head.kind;
  const optional = layer in LAYERS || layer.startsWith("image:");
  if (optional && !wanted.has(layer)) return; // it was on its way when it was switched off
  handlers[head.kind](head, body);
}

function want() {
  if (socket?.readyState !== WebSocket.OPEN) return;
  // A hidden page wants nothing.
  socket.send(JSON.stringify({ want: document.hidden ? [] : [...wanted] }));
}

async function ask(what, order = {}) {
  try {
    const response = await fetch(`/${what}`, {
      method: "POST",
      headers: { "Content-Type": "application/json", Authorization: `Bearer ${token}` },
      body: JSON.stringify(order),
    });
    const text = await response.text();
    return response.headers.get("Content-Type")?.includes("json") ? JSON.parse(text) : { success: false, code: response.status, message: text };
  } catch (error) {
    return { success: false, code: "NOT_READY", message: `the server of this page does not answer (${error.message})` };
  }
}

function showLink(level, text) {
  $("link").dataset.level = level;
  $("link").textContent = text;
}

function showFault({ layer, text }) {
  const name = `fault-${layer}`;
  document.getElementById(name)?.remove();
  if (text) $("faults").append(element("li", { id: name, text }));
}

// --- what is drawn
const GLASS = [0.31, 0.7, 0.75];

function showRobot(robot) {
  links = new Map(robot.links.map((name) => [name, group()]));
  const all = [...links.values()];
  meshes = robot.shapes.filter(({ kind }) => kind === "mesh");
  complete = meshes.length === 0;
  for (const { link, kind, size, pose, color } of robot.shapes.filter((shape) => shape.kind !== "mesh")) {
    const [a, b] = [2 * size[0], size[1]];
    all[link].add(solid(kind, pose, { box: size, cylinder: [a, a, b], sphere: [a, a, a] }[kind], color.slice(0, 3)));
  }
  all.forEach((link) => (link.visible = false)); // until it is known where it is
  scene.set("robot", ...all);
}

/** The robot's meshes: nine numbers a triangle, `counts` of them from each file, one after the other. */
function showMeshes(counts, body) {
  let at = 0;
  const files = counts.map((count) => {
    const file = facets(new Float32Array(body, at, 9 * count));
    at += 36 * count;
    return file;
  });
  const all = [...links.values()];
  for (const { link, mesh, size, pose, color } of meshes) all[link].add(faceted(files[mesh], pose, size, color.slice(0, 3)));
  complete = true;
  scene.redraw();
}

/** From the floor over the table top (0.4 m) and what stands on it to what is above. */
const HEIGHTS = [[0, [0.2, 0.42, 0.6]], [0.4, [0.42, 0.58, 0.56]], [0.5, [0.85, 0.62, 0.32]], [1, [0.8, 0.34, 0.3]]];

function heightColor(z) {
  const above = Math.max(1, HEIGHTS.findIndex(([height], i) => z < height || i === HEIGHTS.length - 1));
  const [[low, a], [high, b]] = [HEIGHTS[above - 1], HEIGHTS[above]];
  const u = Math.min(1, Math.max(0, (z - low) / (high - low)));
  return a.map((v, i) => v + u * (b[i] - v));
}

function drawDetections() {
  scene.set("detections", ...boxes.flatMap(({ pose, size }) => [solid("box", pose, size, GLASS, 0.18), boxEdges(pose, size, GLASS)]));
  // In place: a label that is made anew between press and release is not clicked.
  const labels = $("labels");
  while (labels.children.length > boxes.length) labels.lastChild.remove();
  while (labels.children.length < boxes.length) labels.append(makeLabel(labels.children.length));
  boxes.forEach((box, i) => {
    const [name, score] = labels.children[i].children;
    name.textContent = box.label;
    score.textContent = box.score > 0 ? `${Math.round(100 * box.score)} %` : "not measured"; // in the way, no more
    labels.children[i].title = `${box.size.map((v) => (100 * v).toFixed(1)).join(" × ")} cm`;
  });
  markChosen(asking.label);
  placeLabels();
}

function makeLabel(i) {
  const label = element("button", { type: "button" }, element("span"), element("small"));
  label.addEventListener("click", () => asking.choose(boxes[i].label));
  return label;
}

function markChosen(chosen) {
  [...$("labels").children].forEach((label, i) => label.setAttribute("aria-pressed", boxes[i].label === chosen));
}

function placeLabels() {
  [...$("labels").children].forEach((label, i) => {
    const { pose, size } = boxes[i];
    const at = scene.onScreen([pose[12], pose[13], pose[14] + size[2] / 2 + 0.02]);
    label.hidden = !at;
    if (at) label.style.transform = `translate(${at[0].toFixed(1)}px, ${at[1].toFixed(1)}px) translate(-50%, -100%)`;
  });
}

function drawFloor() {
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  scene.setTheme(dark
    ? { background: [0.06, 0.078, 0.086], sky: [0.6, 0.64, 0.66], ground: [0.34, 0.34, 0.36] }
    : { background: [0.914, 0.933, 0.941], sky: [0.68, 0.7, 0.71], ground: [0.44, 0.43, 0.42] });
  const [ends, colors] = [[], []];
  const line = (a, b) => {
    for (let k = 0; k < 20; k++) {
      for (const u of [k / 20, (k + 1) / 20]) {
        const point = a.map((v, i) => v + u * (b[i] - v));
        const fade = Math.max(0, 1 - Math.hypot(point[0] - 0.3, point[1]) / 1.9);
        ends.push(point);
        colors.push([...(dark ? [150, 170, 178] : [90, 110, 118]), 110 * fade]);
      }
    }
  };
  for (let k = -8; k <= 8; k++) {
    line([k / 4 + 0.25, -2, 0], [k / 4 + 0.25, 2, 0]);
    line([-1.75, k / 4, 0], [2.25, k / 4, 0]);
  }
  scene.set("floor", lines(ends, colors));
}

// --- what can be chosen
function toggle(layer, on) {
  on ? wanted.add(layer) : wanted.delete(layer);
  want();
  if (on) return;
  showFault({ layer, text: "" });
  scene.remove(layer);
  if (layer === "detections") $("labels").replaceChildren();
}

function makeLayers() {
  for (const [layer, name] of Object.entries(LAYERS)) {
    const button = element("button", { type: "button", "aria-pressed": wanted.has(layer), text: name });
    button.addEventListener("click", () => {
      const on = !wanted.has(layer);
      button.setAttribute("aria-pressed", on);
      toggle(layer, on);
    });
    $("layers").append(button);
  }
}

function makeArms(names) {
  $("arms").hidden = names.length < 2;
  for (const name of names) {
    const input = element("input", { type: "radio", name: "arm", value: name });
    $("arms").append(element("label", {}, input, element("span", { text: name })));
  }
}

function makeCameras(names, closed) {
  for (const name of names) {
    const picture = element("img", { alt: `image of the ${name} camera` });
    const button = element("button", { type: "button", text: name });
    const figure = element("figure", { "data-camera": name }, picture, button);
    const set = (on) => {
      figure.dataset.open = on;
      button.setAttribute("aria-pressed", on);
      button.title = on ? `close ${name}` : `open ${name}`;
      if (!on) picture.removeAttribute("src");
      toggle(`image:${name}`, on);
    };
    button.addEventListener("click", () => set(figure.dataset.open !== "true"));
    picture.addEventListener("click", () => figure.classList.toggle("large"));
    $("cameras").append(figure);
    set(name !== closed); // rendered for people alone, so only when asked for
  }
}

makeLayers();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawFloor);
document.addEventListener("visibilitychange", want);
connect();
