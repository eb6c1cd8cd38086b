/** The section that says whether the policy acts the same in this browser, and how fast. */

import { $, h, milliseconds, text } from "./dom.mjs";
import { check, readGolden, visitor } from "./golden.mjs";
import { engine } from "./names.mjs";

const RULE = "|a − b| ≤ 1e-5 + 1e-5·|b|";

export class Verdict {
  #golden;
  #rows = h("tbody");
  #outputs = h("tbody");
  #results = [];
  #button = h("button", { type: "button", disabled: true, onclick: () => this.run() }, "Check again");

  constructor(host, { backends, absent, original }) {
    this.host = host;
    this.backends = backends;
    /** What the original said of the exported policy, in a sentence: this page runs the export alone. */
    this.original =
      original === null
        ? "The original was not run."
        : `The export agreed with ${original.runtime} (at most ${original.share} of the tolerance).`;
    const head = (...names) => h("thead", {}, h("tr", {}, names.map((name) => h("th", { scope: "col" }, name))));
    const table = (caption, columns, body, extra = "") => {
      return h(
        "div",
        { class: "scroll", tabindex: "0", role: "region", "aria-label": caption },
        h("table", { class: `facts ${extra}` }, h("caption", { class: "hidden" }, caption), head(...columns), body),
      );
    };
    $("check-body").append(
      h("p", { class: "soft" }, `Measured in ${visitor()}.`),
      table(
        "By engine",
        ["Engine", "Verdict", "Worst |Δ|", "Median", "95 % below", "Computes on"],
        this.#rows,
      ),
      h("div", { class: "actions" }, this.#button),
      h(
        "details",
        {},
        h("summary", {}, "Output by output"),
        table("Worst difference of each output", ["Output", "Engine", "Worst |Δ|", "Allowed", "At the input"], this.#outputs),
      ),
      h("p", { class: "soft", id: "check-how" }),
      ...backends.filter(({ large }) => large).map(({ name }) => h("p", { class: "soft" }, `${engine(name)} weighs megabytes and is checked once it is chosen above.`)),
      ...absent.map(({ name, why }) => h("p", { class: "soft" }, `${engine(name)} is left out: ${why}.`)),
    );
  }

  /** Checks the backends: the one that is used first, then the others; what costs megabytes, where it has been chosen. */
  async run() {
    this.#button.disabled = true;
    this.#results = [];
    this.#rows.replaceChildren();
    this.#outputs.replaceChildren();
    const first = this.host.backend;
    const order = [first, ...this.backends.filter(({ name, large }) => name !== first && !large).map(({ name }) => name)];
    try {
      this.#golden ??= await readGolden();
      this.#golden.memory = this.host.policy()?.contract.memory ?? null;
      this.#explain();
      for (const backend of order) {
        this.#say(`Checking on ${engine(backend)} …`);
        this.#add(await check(this.host, backend, this.#golden));
      }
      this.#conclude();
    } catch (error) {
      this.#say(`Not checked: ${error.message}.`, "fail");
    } finally {
      this.#button.disabled = false;
    }
  }

  #say(words, kind = "") {
    $("verdict").className = kind;
    $("verdict").textContent = words;
  }

  #explain() {
    const { cases, left_out: left } = this.#golden;
    const rows = cases.reduce((sum, { rows }) => sum + rows, 0);
    const drawn = left.length ? ` Drawn by chance inside the model, and so not compared: ${left.join(", ")}.` : "";
    $("check-how").textContent =
      `${cases.length} sets of inputs, ${rows} decisions, drawn from what the policy knows of its inputs. Every number must ` +
      `agree with export-model's own kernels, which ran the exported policy, by ${RULE}, every choice exactly. ` +
      `${this.original} Times are of one decision for one agent: ` +
      `inputs given, model run, answer read back.${drawn}`;
  }

  #add(result) {
    this.#results.push(result);
    const { backend, passed, error, median, slow, device } = result;
    const state = error === undefined ? (passed ? "agrees" : "differs") : "did not run";
    const mark = { agrees: "ok", differs: "fail", "did not run": "warn" }[state];
    const cells =
      error === undefined
        ? [text(Math.max(...result.outputs.map((output) => output.worst))), milliseconds(median), milliseconds(slow), device]
        : null;
    this.#rows.append(
      h(
        "tr",
        { "data-backend": backend, "data-state": state },
        h("th", { scope: "row" }, engine(backend)),
        h("td", { class: mark }, `${{ ok: "✓", fail: "✗", warn: "–" }[mark]} ${state}`),
        cells === null ? h("td", { colspan: 4, class: "wide" }, error) : cells.map((cell, i) => h("td", { class: i < 3 ? "number" : "wide" }, cell)),
      ),
    );
    for (const output of result.outputs ?? []) {
      const { atol, rtol, reason } = this.#golden.tolerance[output.name];
      const allowed = `${atol} + ${rtol}·|b|${reason && ` (${reason})`}`;
      this.#outputs.append(
        h(
          "tr",
          {},
          h("th", { scope: "row" }, output.name),
          h("td", {}, engine(backend)),
          h("td", { class: output.passed ? "number" : "number fail" }, text(output.worst)),
          h("td", { class: "wide" }, allowed),
          h("td", { class: "wide" }, output.case ?? ""),
        ),
      );
    }
  }

  #conclude() {
    const ran = this.#results.filter(({ error }) => error === undefined);
    const wrong = ran.filter(({ passed }) => !passed);
    const idle = this.#results.length - ran.length;
    const note = idle === 0 ? "" : ` ${idle} of ${this.#results.length} did not run (see the table).`;
    if (ran.length === 0) return this.#say(`Not checked: no engine ran here.${note}`, "fail");
    if (wrong.length > 0) {
      const said = wrong.map(({ backend, worst }) => `${engine(backend)} is off by ${text(worst.worst)} at ${worst.name}`);
      return this.#say(`✗ Other answers: ${said.join(", ")}.${note}`, "fail");
    }
    const worst = Math.max(...ran.flatMap(({ outputs }) => outputs.map((output) => output.worst)));
    const engines = ran.length === 1 ? "" : ` on ${ran.length} engines`;
    return this.#say(`✓ Computes what was exported (worst ${text(worst)}), checked in your browser${engines}. ${this.original}${note}`, "ok");
  }
}
