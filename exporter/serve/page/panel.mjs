/** The panel: a control for each input of any policy, and what it answers. */

import { Bars, percent, Strip } from "./charts.mjs";
import { $, coalesced, h, milliseconds, newId, text } from "./dom.mjs";
import { Masks, Memory, Picture, Previous, Vector } from "./inputs.mjs";
import { engine } from "./names.mjs";
import { probabilities } from "./player.mjs";

export class Panel {
  #host;
  #contract;
  #controls = { observations: [], parameters: [] };
  #answers = {};
  #seed;
  #exact;
  #timing = h("p", { class: "soft", id: "timing" });
  /** Decides on what the controls say, without a step in time. */
  decide = coalesced(() => this.#decide());

  /** @param {boolean} folded whether it stands behind a scene */
  constructor(host, names, { folded }) {
    this.#host = host;
    this.#contract = host.policy().contract;
    const changed = () => void this.decide();
    const inputs = this.#inputs(names, changed);
    const outputs = this.#outputs(names);
    const columns = h(
      "div",
      { class: "columns" },
      h("div", { class: "asking", role: "group", "aria-label": "Inputs" }, this.#presets(changed), inputs),
      h("div", { class: "numbers answering", role: "region", tabindex: "0", "aria-label": "Answer" }, outputs, this.#timing),
    );
    const title = h("h2", { id: "panel-title" }, folded ? "Try it yourself" : "What does it do?");
    if (folded) {
      const details = h("details", { class: "big" }, h("summary", {}, "Set the observations by hand"), columns);
      details.addEventListener("toggle", () => details.open && this.decide());
      $("panel").append(title, details);
    } else $("panel").append(title, h("p", { class: "lead" }, "Change an input: the policy decides again."), columns);
    $("panel").hidden = false;
    this.#controls.memory?.show();
    if (!folded) void this.decide();
  }

  // ---- the elements -------------------------------------------------------------------------------------------------

  #inputs(names, changed) {
    const contract = this.#contract;
    const branches = contract.branches;
    const made = [];
    for (const spec of contract.inputs) {
      if (spec.role === "visual_observation") made.push(this.#observation(new Picture(spec, contract.preprocess?.[spec.name], changed)));
      else if (["vector_observation", "variable_length_observation"].includes(spec.role)) {
        made.push(this.#observation(new Vector(spec, names, changed)));
      } else if (spec.role === "parameter") {
        const control = new Vector({ ...spec, shape: [1, ...spec.shape] }, names, changed);
        this.#controls.parameters.push({ spec, control });
        made.push(control.element);
      } else if (spec.role === "masks") {
        this.#controls.masks = new Masks(branches.length ? branches : [spec.shape.at(-1)], names, changed);
        made.push(this.#controls.masks.element);
      } else if (spec.role === "prev_action") {
        this.#controls.previous = new Previous(spec, branches, names, changed);
        made.push(this.#controls.previous.element);
      } else if (spec.role === "memory_in" && contract.memory !== null) {
        this.#controls.memory = new Memory(contract.memory, changed);
        made.push(this.#controls.memory.element);
      }
    }
    return [...made, this.#chance(changed)];
  }

  #observation(control) {
    this.#controls.observations.push(control);
    return control.element;
  }

  /** Only where chance has a part. */
  #chance(changed) {
    this.#exact = h("input", { type: "checkbox", id: newId("exact"), checked: true, onchange: changed });
    this.#seed = h("input", { type: "number", id: newId("seed"), min: 0, step: 1, value: 0, oninput: changed });
    const another = () => {
      this.#exact.checked = false;
      this.#seed.value = String(Math.floor(Math.random() * 1e6));
      changed();
    };
    return h(
      "fieldset",
      {},
      h("legend", {}, "Randomness"),
      h(
        "div",
        { class: "boxes" },
        h("span", { class: "field" }, this.#exact, h("label", { for: this.#exact.id }, "Deterministic: the likeliest action, no noise")),
        h("span", { class: "field" }, h("label", { for: this.#seed.id }, "Seed"), this.#seed),
        h("button", { type: "button", onclick: another }, "Draw another"),
      ),
    );
  }

  #presets(changed) {
    const all = () => [...this.#controls.observations, ...this.#controls.parameters.map(({ control }) => control)];
    const reset = () => {
      [...all(), this.#controls.masks, this.#controls.previous, this.#controls.memory].forEach((control) => control?.middle());
      changed();
    };
    const random = () => {
      all().forEach((control) => control.random());
      changed();
    };
    const step = this.#controls.memory || this.#contract.memory || this.#contract.inputs.some(({ role }) => role === "prev_action");
    return h(
      "div",
      { class: "controls" },
      h("button", { type: "button", onclick: random }, "Random inputs"),
      h("button", { type: "button", onclick: reset }, "Reset"),
      step && h("button", { type: "button", id: "next-step", onclick: () => this.#host && void this.#step() }, "Next step"),
    );
  }

  #outputs(names) {
    const contract = this.#contract;
    const made = [];
    if (contract.action_space !== "discrete") {
      const head = contract.outputs.find(({ role, dtype }) => role === "continuous" || (role === "deterministic" && dtype === "float32"));
      this.#answers.continuous = new Bars("Actions", names.continuous(head.shape.at(-1) ?? 1));
      made.push(this.#answers.continuous.element);
    }
    if (contract.action_space !== "continuous") {
      this.#answers.branches = contract.branches.map((count, i) => {
        return new Bars(contract.branches.length > 1 ? `Action of branch ${i}` : "Action", names.branch(i, count), { from: "left" });
      });
      made.push(...this.#answers.branches.map(({ element }) => element));
    }
    if (contract.memory?.output) {
      this.#answers.memory = new Strip("The memory that comes out");
      made.push(h("figure", {}, h("figcaption", {}, "Memory afterwards"), this.#answers.memory.element));
    }
    this.#answers.others = contract.outputs.slice(1).filter(({ role }) => ["value_estimate", "q_values", "other"].includes(role));
    this.#answers.list = h("dl", { class: "others" });
    made.push(this.#answers.list);
    return made;
  }

  // ---- deciding -----------------------------------------------------------------------------------------------------

  async #ask() {
    const { observations, parameters, masks, previous, memory } = this.#controls;
    const seed = Math.trunc(this.#seed.valueAsNumber);
    const given = Object.fromEntries(observations.map((control) => [control.name, control.value()]));
    const begin = performance.now();
    const decision = await this.#host.decide("model", given, {
      masks: masks?.value(),
      previous: previous?.value(),
      memory: memory?.value(),
      parameters: Object.fromEntries(parameters.map(({ spec, control }) => [spec.name, shaped(spec, control.value())])),
      deterministic: this.#exact.checked,
      seed: seed >= 0 && Number.isSafeInteger(seed) ? seed : 0,
    });
    this.#show(decision, performance.now() - begin);
    return decision;
  }

  async #decide() {
    try {
      await this.#ask();
    } catch (error) {
      this.#timing.textContent = `It cannot decide: ${error.message}`;
    }
  }

  /** A decision after which time goes on: memory and the last action are fed back. */
  async #step() {
    try {
      const decision = await this.#ask();
      this.#controls.memory?.keep(decision.memory);
      if (decision.discrete !== null) this.#controls.previous?.set(decision.discrete[0]);
      await this.decide();
    } catch (error) {
      this.#timing.textContent = `It cannot decide: ${error.message}`;
    }
  }

  #show({ continuous, discrete, memory, outputs }, took) {
    this.#answers.continuous?.show(continuous[0]);
    const shares = this.#answers.branches && probabilities(this.#contract, outputs);
    this.#answers.branches?.forEach((bars, branch) => {
      bars.show(shares?.[branch] ?? [], { chosen: discrete[0][branch], write: (v) => (v === undefined ? "" : percent(v)) });
    });
    if (memory !== null) this.#answers.memory?.show(memory.data);
    this.#answers.list.replaceChildren(
      ...this.#answers.others.flatMap(({ name }) => {
        const { data } = outputs[name];
        const words = data.length > 8 ? `${data.length} numbers` : Array.from(data, (v) => text(v)).join(", ");
        return [h("dt", {}, name), h("dd", {}, words)];
      }),
    );
    this.#timing.textContent = `Decided in ${milliseconds(took)} on ${engine(this.#host.backend)}.`;
  }
}

/** A parameter has no axis for agents. */
const shaped = (spec, { data }) => ({ data, shape: spec.shape.map((n) => n ?? 1) });
