/** Numbers as bars and as a strip of colours. The bars are tables, so that a screen reader reads names and values. */

import { fixed, h, text } from "./dom.mjs";

/** Rows of a name, a bar and a value. `from` is where bars start: "zero" in the middle, or "left" for 0 to 1. */
export class Bars {
  #rows = [];
  #from;
  #most;
  #body = h("tbody");

  constructor(caption, names, { from = "zero", most = 1, hideCaption = false } = {}) {
    this.#from = from;
    this.#most = most;
    this.element = h(
      "table",
      { class: `bars ${from}` },
      h("caption", { class: hideCaption ? "hidden" : "" }, caption),
      this.#body,
    );
    this.rename(names);
  }

  rename(names) {
    this.#rows = names.map((name) => {
      const [fill, value] = [h("span", { class: "fill" }), h("td", { class: "value" })];
      const track = h("td", { class: "track", "aria-hidden": "true" }, h("span", {}, fill));
      const row = h("tr", {}, h("th", { scope: "row" }, name), track, value);
      return { row, fill, value };
    });
    this.#body.replaceChildren(...this.#rows.map(({ row }) => row));
  }

  /** @param {number} chosen the row to mark, if any */
  show(values, { chosen = -1, write = fixed } = {}) {
    for (const v of values) if (Number.isFinite(v)) this.#most = Math.max(this.#most, Math.abs(v));
    this.#rows.forEach(({ row, fill, value }, i) => {
      const share = Number.isFinite(values[i]) ? Math.min(Math.abs(values[i]) / this.#most, 1) : 0;
      const width = this.#from === "zero" ? share / 2 : share;
      const left = this.#from === "zero" ? (values[i] < 0 ? 0.5 - width : 0.5) : 0;
      fill.style.insetInlineStart = `${100 * left}%`;
      fill.style.inlineSize = `${100 * width}%`;
      const said = `${write(values[i])}${i === chosen ? " ✓" : ""}`;
      if (value.textContent !== said) value.textContent = said;
      row.classList.toggle("chosen", i === chosen);
    });
  }
}

export const percent = (share) => `${(100 * share).toFixed(share > 0.0995 || share < 0.0005 ? 0 : 1)} %`;

/** Numbers as cells from blue over paper to orange; ±`most` are the full colours. */
export class Strip {
  constructor(label) {
    this.element = h("canvas", { class: "strip", role: "img", "aria-label": label, height: 1, width: 1 });
    this.label = label;
  }

  show(values) {
    const count = values.length;
    const columns = count > 64 ? Math.ceil(count / Math.ceil(count / 64)) : count;
    const canvas = this.element;
    [canvas.width, canvas.height] = [Math.max(columns, 1), Math.max(Math.ceil(count / columns), 1)];
    canvas.style.aspectRatio = `${canvas.width} / ${canvas.height * (count > 64 ? 1 : 2)}`;
    const context = canvas.getContext("2d");
    const most = values.reduce((a, v) => Math.max(a, Math.abs(v)), 1e-9);
    const [low, high] = ["--cold", "--warm"].map((name) => getComputedStyle(canvas).getPropertyValue(name).trim());
    values.forEach((value, i) => {
      context.globalAlpha = Math.min(Math.abs(value) / most, 1);
      context.fillStyle = value < 0 ? low : high;
      context.fillRect(i % columns, Math.floor(i / columns), 1, 1);
    });
    const zero = values.every((v) => v === 0);
    canvas.setAttribute("aria-label", `${this.label}: ${count} numbers, ${zero ? "all 0" : `the largest ±${text(most)}`}`);
  }
}

const [LOWEST, HIGHEST, SECONDS] = [-9, 1, 20];

/** How far two runs are apart over the last seconds: powers of ten, from 1e-9 to 10. */
export class Divergence {
  #canvas = h("canvas", { class: "divergence", role: "img", "aria-label": "How far the two are apart" });
  #words = h("p", { class: "status", id: "apart" });
  #points = [];

  constructor() {
    const key = (name, words) => h("span", { class: `key ${name}` }, words);
    this.element = h("div", { id: "divergence", hidden: true }, h("p", { class: "title" }, "Largest difference of the ", key("cold", "answers"), " and of the ", key("warm", "states")), this.#canvas, this.#words);
  }

  clear() {
    this.#points = [];
    this.#words.textContent = "";
  }

  add(seconds, answers, states) {
    this.#points.push({ seconds, values: [answers, states] });
    while (this.#points.length > 2000 || this.#points[0].seconds < seconds - SECONDS) this.#points.shift();
  }

  draw() {
    const last = this.#points.at(-1);
    const canvas = this.#canvas;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (last === undefined || width === 0) return;
    const density = Math.min(window.devicePixelRatio || 1, 2);
    [canvas.width, canvas.height] = [Math.round(width * density), Math.round(height * density)];
    const context = canvas.getContext("2d");
    context.scale(density, density);
    const style = getComputedStyle(canvas);
    const colour = (name) => style.getPropertyValue(name).trim();
    const y = (value) => {
      const power = Math.min(Math.max(Math.log10(value), LOWEST), HIGHEST);
      return 4 + (1 - (power - LOWEST) / (HIGHEST - LOWEST)) * (height - 8);
    };
    context.font = "11px system-ui, sans-serif";
    context.textBaseline = "middle";
    for (const power of [-9, -6, -3, 0]) {
      context.fillStyle = colour("--rule");
      context.fillRect(44, y(10 ** power), width - 44, 1);
      context.fillStyle = colour("--soft");
      context.fillText(power === -9 ? "≤ 1e-9" : power === 0 ? "1" : `1e${power}`, 0, Math.min(y(10 ** power), height - 7));
    }
    ["--cold", "--warm"].forEach((name, k) => {
      context.strokeStyle = colour(name);
      context.lineWidth = 1.6;
      context.beginPath();
      for (const { seconds, values } of this.#points) {
        context.lineTo(width - ((last.seconds - seconds) / SECONDS) * (width - 44), y(values[k]));
      }
      context.stroke();
    });
    const [answers, states] = last.values.map((value) => (value < 1e-3 && value > 0 ? value.toExponential(1) : text(value)));
    this.#words.textContent = `Now the answers differ by ${answers}, the states by ${states}.`;
  }
}
