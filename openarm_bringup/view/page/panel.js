// SPDX-License-Identifier: Apache-2.0
// The panel next to the scene: the state of the grasp, requests, the health of the nodes.
// What comes from the graph is shown as text (textContent), never as markup.

const $ = (id) => document.getElementById(id);

/** Colours of the labels that the detector knows; others stay grey. */
const SWATCHES = { red: "#d64541", orange: "#e8863a", yellow: "#e3c02f", green: "#4a9d5b", blue: "#3f74c9", purple: "#8657b5" };

/** What the node that commands the joints reports while its emergency stop is latched. */
const LATCHED = "the emergency stop is latched";

export function element(tag, { text, ...attributes } = {}, ...children) {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

const swatch = (label) => SWATCHES[label] ?? "#8b989e";
const spoken = (state) => state.charAt(0) + state.slice(1).toLowerCase().replaceAll("_", " ");

/** Object and arm of a step: two objects may be picked simultaneously. */
const whose = ({ label, arm }) => [label, arm && `${arm} arm`].filter(Boolean);

function tell(id, { success, code, message }) {
  $(id).dataset.result = success ? "success" : "failure";
  $(id).textContent = success ? message : `${code}: ${message}`;
}

export class GraspPanel {
  /** @param ask sends a request and gives its answer */
  constructor(ask) {
    this.ask = ask;
    this.plan = ""; // that waits
    $("run").addEventListener("click", () => this.#answer(true));
    $("reject").addEventListener("click", () => this.#answer(false));
  }

  setStates(states) {
    this.states = states;
    $("track").replaceChildren(...states.map((state) => element("li", { title: spoken(state) })));
  }

  show({ steps }) {
    const last = steps.at(-1);
    const at = this.states.indexOf(last.state);
    $("state").textContent = spoken(last.state);
    $("reason").textContent = last.reason;
    const facts = last.attempt > 0 ? [...whose(last), `attempt ${last.attempt}`] : whose(last);
    $("facts").textContent = facts.join(" · ");
    [...$("track").children].forEach((bar, i) => {
      bar.className = at === 0 ? "" : i < at ? "past" : i === at ? "now" : "";
    });
    this.plan = last.plan_id;
    $("confirm").hidden = !this.plan;
    $("confirm-answer").textContent = "";
    $("steps").replaceChildren(...steps.map((step) => this.#row(step)).reverse());
  }

  async #answer(accept) {
    const answer = await this.ask("confirm", { plan_id: this.plan, accept });
    if (!answer.success) tell("confirm-answer", answer); // else the next step says it
  }

  #row(step) {
    const of = element("em", { text: whose(step).join(" · ") });
    of.style.setProperty("--swatch", swatch(step.label));
    const head = [element("time", { text: `${step.t.toFixed(1)} s` }), element("b", { text: spoken(step.state) }), of];
    return element("li", {}, ...head, element("span", { text: step.reason }));
  }
}

export class AskPanel {
  /** @param ask sends a request and gives its answer  @param onChosen called with the label that is to be picked */
  constructor(ask, onChosen) {
    this.ask = ask;
    this.onChosen = onChosen;
    this.labels = null;
    this.label = null; // what a click would pick
    this.wish = null; // what was chosen last; it may be out of sight for a while
    this.running = false;
    $("ask").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#pick(new FormData($("ask")));
    });
    $("cancel").addEventListener("click", () => this.#cancel());
    $("reset").addEventListener("click", () => this.#reset({}));
    $("shuffle").addEventListener("click", () => this.#reset({ scene: "random", seed: Math.floor(Math.random() * 1e6) }));
  }

  setDetections(boxes) {
    const labels = [...new Set(boxes.map((box) => box.label))].sort();
    if (labels.join() === this.labels?.join()) return;
    this.labels = labels;
    this.#select(labels.includes(this.wish) ? this.wish : (labels[0] ?? null));
  }

  choose(label) {
    this.wish = label;
    this.#select(label);
  }

  #select(label) {
    this.label = label;
    const chips = (this.labels ?? []).map((name) => {
      const chip = element("button", { type: "button", role: "radio", "aria-checked": name === label, text: name });
      chip.style.setProperty("--swatch", swatch(name));
      chip.addEventListener("click", () => this.choose(name));
      return chip;
    });
    $("choices").replaceChildren(...(chips.length ? chips : [element("span", { text: "nothing detected" })]));
    this.#enable();
    this.onChosen(label);
  }

  showOutcome(outcome) {
    this.running = outcome.running;
    this.#enable();
    if (outcome.running) {
      $("outcome").textContent = "";
    } else {
      tell("outcome", outcome);
    }
  }

  async #pick(form) {
    const [dry_run, confirm] = [form.has("dry_run"), form.has("confirm")];
    const answer = await this.ask("pick", { label: this.label, arm: form.get("arm"), dry_run, confirm });
    if (!answer.success) tell("outcome", answer);
  }

  async #cancel() {
    const answer = await this.ask("cancel");
    if (!answer.success) tell("outcome", answer); // else the end of the grasp says it, perhaps before this answer
  }

  async #reset(order) {
    const answer = await this.ask("reset", order);
    tell("world-answer", answer);
  }

  #enable() {
    $("pick").disabled = this.running || this.label === null;
    $("pick").textContent = this.running ? "Picking…" : this.label === null ? "Pick" : `Pick ${this.label}`;
  }
}

/** The emergency stop: the button and Shift+Esc latch it; it is shown until it is released, by whomever. */
export class StopPanel {
  /** @param ask sends a request and gives its answer */
  constructor(ask) {
    this.ask = ask;
    $("stop").addEventListener("click", () => this.#stop());
    $("release").addEventListener("click", () => this.#release());
    document.addEventListener("keydown", (event) => {
      if (event.key !== "Escape" || !event.shiftKey || event.repeat) return;
      event.preventDefault();
      this.#stop();
    });
  }

  /** What the nodes report: a stop of another client is shown too. */
  show({ nodes }) {
    const latched = nodes.some((node) => node.message === LATCHED);
    if (latched && $("stopped").hidden) $("stop-answer").textContent = LATCHED;
    if (latched) this.latched = true;
    else if (this.latched) this.#clear();
    if (latched) $("stopped").hidden = false;
  }

  async #stop() {
    $("stopped").hidden = false;
    $("stop-answer").textContent = "stopping…";
    tell("stop-answer", await this.ask("stop"));
  }

  async #release() {
    const answer = await this.ask("release");
    if (answer.success) this.#clear();
    else tell("stop-answer", answer);
  }

  #clear() {
    this.latched = false;
    $("stopped").hidden = true;
  }
}

export class HealthPanel {
  constructor() {
    this.rows = new Map();
  }

  show({ nodes, speed }) {
    if (speed !== null) $("speed").textContent = `${speed.toFixed(2)}×`;
    for (const node of nodes) this.#fill(this.rows.get(node.name) ?? this.#add(node.name), node);
  }

  #add(name) {
    const row = { said: element("em"), facts: element("dl") };
    row.summary = element("summary", {}, element("span", { text: name }), row.said);
    row.item = element("li", { "data-name": name }, element("details", {}, row.summary, row.facts));
    this.rows.set(name, row);
    $("nodes").replaceChildren(...[...this.rows].sort(([a], [b]) => a.localeCompare(b)).map(([, { item }]) => item));
    return row;
  }

  #fill(row, node) {
    row.item.dataset.level = node.level;
    row.said.textContent = node.message;
    row.summary.title = node.message;
    const facts = Object.entries(node.values).flatMap(([key, value]) => [element("dt", { text: key }), element("dd", { text: value })]);
    row.facts.replaceChildren(element("p", { text: node.message }), ...facts);
  }
}
