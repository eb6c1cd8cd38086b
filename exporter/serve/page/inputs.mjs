/** The controls for a policy's inputs. Each has `element`, `value()` as policy.decide takes it, and presets. */

import { Strip } from "./charts.mjs";
import { h, newId } from "./dom.mjs";
import { fed, imageForm } from "./images.mjs";

/** What a free axis behind the batch is, where it is no image: the number of entities. */
const FREE_COUNT = 4;
/** Sliders beyond these are folded away. */
const SHOWN = 16;

const size = (shape) => shape.reduce((product, n) => product * n, 1);

/** Numbers, a slider and a box each; around the statistics of the policy's normaliser where it has one. */
export class Vector {
  #sliders = [];
  #shape;

  constructor(spec, names, changed) {
    this.name = spec.name;
    this.#shape = [1, ...spec.shape.slice(1).map((n) => n ?? FREE_COUNT)];
    const count = size(this.#shape);
    const { mean, std } = spec.distribution ?? {};
    const at = (values, i, otherwise) => (Array.isArray(values) ? values[i % values.length] : values) ?? otherwise;
    this.#sliders = names.observation(spec, count).map((name, i) => {
      const middle = std === undefined ? 0 : at(mean, i, 0);
      const reach = std === undefined ? 1 : Math.max(3 * at(std, i, 1), 1e-3);
      return new Slider(name, middle, reach, changed);
    });
    const rows = this.#sliders.map(({ element }) => element);
    const about = std === undefined ? "" : " (mean ± 3 standard deviations in training)";
    this.element = h(
      "fieldset",
      {},
      h("legend", {}, `${spec.name}${about}`),
      h("div", { class: "sliders" }, rows.slice(0, SHOWN)),
      rows.length > SHOWN &&
        h("details", {}, h("summary", {}, `${rows.length - SHOWN} more`), h("div", { class: "sliders" }, rows.slice(SHOWN))),
    );
  }

  value() {
    return { data: Float32Array.from(this.#sliders, (slider) => slider.value), shape: this.#shape };
  }

  middle() {
    for (const slider of this.#sliders) slider.set(slider.middle);
  }

  random() {
    for (const slider of this.#sliders) slider.set(slider.middle + slider.reach * (2 * Math.random() - 1));
  }
}

class Slider {
  constructor(name, middle, reach, changed) {
    Object.assign(this, { middle, reach });
    const id = newId("number");
    const [low, high] = [middle - reach, middle + reach];
    this.#range = h("input", { type: "range", id, min: low, max: high, step: "any", value: middle });
    this.#box = h("input", { type: "number", step: "any", value: shown(middle), "aria-label": `${name}, as a number` });
    this.#range.addEventListener("input", () => {
      this.value = Number(this.#range.value);
      this.#box.value = shown(this.value);
      changed();
    });
    this.#box.addEventListener("input", () => {
      if (!Number.isFinite(this.#box.valueAsNumber)) return; // still being typed
      this.value = this.#box.valueAsNumber; // beyond the slider's ends, if it is so meant
      this.#range.value = this.value;
      changed();
    });
    // Steps of a fiftieth by the arrow keys: "any" alone gives steps of 1.
    this.#range.addEventListener("keydown", (event) => {
      const way = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -5, PageUp: 5 }[event.key];
      if (way === undefined) return;
      event.preventDefault();
      this.set(Math.min(Math.max(this.value + (way * reach) / 25, low), high));
      changed();
    });
    this.value = middle;
    this.element = h("div", { class: "slider" }, h("label", { for: id }, name), this.#range, this.#box);
  }

  #range;
  #box;

  set(value) {
    this.value = value;
    this.#range.value = value;
    this.#box.value = shown(value);
  }
}

const shown = (value) => String(Number(value.toPrecision(4)));

/** An image that can be painted, filled or drawn by chance. */
export class Picture {
  #pixels;
  #canvas;
  #brush;
  #form;

  constructor(spec, preprocess, changed) {
    this.name = spec.name;
    this.#form = imageForm(spec, preprocess);
    const { height, width, channels } = this.#form;
    this.#pixels = new Float32Array(height * width * channels);
    this.changed = changed;
    this.#canvas = h("canvas", { class: "picture", width, height, role: "img" });
    this.#brush = h("input", { type: channels === 3 ? "color" : "range", id: newId("brush"), value: channels === 3 ? "#ff9933" : 1 });
    if (channels !== 3) Object.assign(this.#brush, { min: 0, max: 1, step: 0.05, value: 1 });
    const paint = (event) => event.buttons === 1 && this.#paint(event);
    this.#canvas.addEventListener("pointerdown", paint);
    this.#canvas.addEventListener("pointermove", paint);
    const button = (words, colourAt) => h("button", { type: "button", onclick: () => this.#all(colourAt) }, words);
    const sweep = (y, x, c) => [x / Math.max(width - 1, 1), y / Math.max(height - 1, 1), 0.5][c % 3];
    this.element = h(
      "fieldset",
      {},
      h("legend", {}, `${spec.name} (${width} × ${height}, ${channels} ${channels === 1 ? "channel" : "channels"})`),
      h(
        "div",
        { class: "painting" },
        this.#canvas,
        h(
          "div",
          { class: "controls" },
          h("span", { class: "field" }, h("label", { for: this.#brush.id }, "Brush"), this.#brush),
          button("Fill", (y, x, c) => this.#colour()[c]),
          button("Clear", () => 0),
          button("Ramp", sweep),
          button("Noise", () => Math.random()),
        ),
      ),
    );
    this.middle();
  }

  value() {
    return fed(this.#pixels, this.#form);
  }

  middle() {
    this.#all(() => 0.5, false);
  }

  random() {
    this.#all(() => Math.random(), false);
  }

  #colour() {
    const { value, type } = this.#brush;
    if (type !== "color") return new Array(this.#form.channels).fill(Number(value));
    return [1, 3, 5].map((at) => parseInt(value.slice(at, at + 2), 16) / 255);
  }

  #all(colourAt, tells = true) {
    const { width, channels } = this.#form;
    this.#pixels.forEach((_, i) => {
      const place = Math.floor(i / channels);
      this.#pixels[i] = colourAt(Math.floor(place / width), place % width, i % channels);
    });
    this.#show();
    if (tells) this.changed();
  }

  #paint(event) {
    const { height, width, channels } = this.#form;
    const box = this.#canvas.getBoundingClientRect();
    const x = Math.floor(((event.clientX - box.left) / box.width) * width);
    const y = Math.floor(((event.clientY - box.top) / box.height) * height);
    const reach = Math.max(Math.round(Math.min(width, height) / 24), 0);
    const colour = this.#colour();
    for (let v = Math.max(y - reach, 0); v <= Math.min(y + reach, height - 1); v++) {
      for (let u = Math.max(x - reach, 0); u <= Math.min(x + reach, width - 1); u++) {
        for (let c = 0; c < channels; c++) this.#pixels[(v * width + u) * channels + c] = colour[c];
      }
    }
    this.#show();
    this.changed();
  }

  #show() {
    const { height, width, channels } = this.#form;
    const image = new ImageData(width, height);
    let sum = 0;
    for (let i = 0; i < width * height; i++) {
      const own = this.#pixels.subarray(i * channels, (i + 1) * channels);
      const grey = own.reduce((a, b) => a + b, 0) / channels;
      sum += grey;
      const rgb = channels === 3 ? own : [grey, grey, grey];
      for (let c = 0; c < 3; c++) image.data[4 * i + c] = 255 * rgb[c];
      image.data[4 * i + 3] = 255;
    }
    this.#canvas.getContext("2d").putImageData(image, 0, 0);
    const mean = ((100 * sum) / (width * height)).toFixed(0);
    this.#canvas.setAttribute("aria-label", `The image ${this.name}, ${width} by ${height}, ${mean} percent bright on average`);
  }
}

/** Which actions are allowed, by branch; one of each branch always is. */
export class Masks {
  #branches;

  constructor(branches, names, changed) {
    this.#branches = branches.map((count, branch) => names.branch(branch, count).map((name) => {
      const box = h("input", { type: "checkbox", id: newId("mask"), checked: true });
      return { box, name };
    }));
    const groups = this.#branches.map((group, branch) => {
      const note = h("span", { class: "soft", role: "status" });
      for (const { box } of group) {
        box.addEventListener("change", () => {
          const none = group.every((other) => !other.box.checked);
          if (none) box.checked = true;
          note.textContent = none ? "One action must stay allowed." : "";
          changed();
        });
      }
      const fields = group.map(({ box, name }) => h("span", { class: "field" }, box, h("label", { for: box.id }, name)));
      return h("fieldset", {}, h("legend", {}, `Allowed actions${branches.length > 1 ? `, branch ${branch}` : ""}`), h("div", { class: "boxes" }, fields, note));
    });
    this.element = h("div", {}, groups);
  }

  value() {
    return [this.#branches.flat().map(({ box }) => Number(box.checked))];
  }

  middle() {
    this.#branches.flat().forEach(({ box }) => (box.checked = true));
  }
}

/** The previous action, one choice per branch. */
export class Previous {
  #selects;

  constructor(spec, branches, names, changed) {
    const count = spec.shape[1] ?? 1;
    this.#selects = Array.from({ length: count }, (_, i) => {
      const options = names.branch(i, branches[i] ?? branches[0] ?? 2).map((name, value) => h("option", { value }, name));
      return h("select", { id: newId("previous"), onchange: changed }, options);
    });
    const fields = this.#selects.map((select, i) => {
      return h("span", { class: "field" }, h("label", { for: select.id }, count > 1 ? `branch ${i}` : "action"), select);
    });
    this.element = h("fieldset", {}, h("legend", {}, "Previous action"), h("div", { class: "boxes" }, fields));
  }

  value() {
    return [this.#selects.map((select) => Number(select.value))];
  }

  middle() {
    this.#selects.forEach((select) => (select.value = "0"));
  }

  /** @param {number[]} actions of the last decision */
  set(actions) {
    this.#selects.forEach((select, i) => (select.value = String(actions[i])));
  }
}

/** The memory: shown, fed back or not, made zero. */
export class Memory {
  #strip;
  #kept;
  #feeds;

  constructor(memory, changed) {
    this.#kept = new Float32Array(memory.size);
    this.#strip = new Strip(`The memory that goes in${memory.layout.length ? ` (${memory.layout.join(", then ")})` : ""}`);
    this.#feeds = h("input", { type: "checkbox", id: newId("feed"), checked: true });
    const forget = () => {
      this.middle();
      changed();
    };
    this.element = h(
      "fieldset",
      {},
      h("legend", {}, `Memory, ${memory.size} numbers${memory.layout.length ? `: ${memory.layout.join(", ")}` : ""}`),
      this.#strip.element,
      h(
        "div",
        { class: "boxes" },
        h("span", { class: "field" }, this.#feeds, h("label", { for: this.#feeds.id }, "Feed it back at each step")),
        h("button", { type: "button", onclick: forget }, "Forget"),
      ),
    );
  }

  value() {
    return { data: this.#kept, shape: [1, this.#kept.length] };
  }

  middle() {
    this.#kept = new Float32Array(this.#kept.length);
    this.show();
  }

  show() {
    this.#strip.show(this.#kept);
  }

  /** What came out of a step. */
  keep(memory) {
    if (this.#feeds.checked && memory !== null) this.#kept = Float32Array.from(memory.data);
    this.show();
  }
}
