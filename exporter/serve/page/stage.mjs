/** A scene: the environment is simulated, the policy acts in it, and both are drawn. */

import { Bars, percent } from "./charts.mjs";
import { $, frame, h } from "./dom.mjs";
import { Player, probabilities } from "./player.mjs";
import { palette } from "./views/drawing.mjs";

const SPEEDS = [0.25, 0.5, 1, 2, 4, 8];
/** A page that was held up goes on from where it is, and does not rush. */
const MOST_BEHIND = 0.25; // s
const STEPS_A_FRAME = 12;
/** How often numbers and the text for screen readers change, in ms. */
const NUMBERS_EVERY = 100;
const TEXT_EVERY = 2000;

export class Stage {
  #view;
  #host;
  #env;
  #players;
  #observation;
  #before = null;
  #after;
  #tally;
  #chosen = 0;
  #decision = null;
  #paused = true;
  #seed = 0;
  #parts = {};
  #bars = {};
  #shown = { numbers: 0, text: 0 };
  #colours;
  #busy = Promise.resolve();
  /** The loop that runs; one that was paused and has not noticed yet is another. */
  #loop = 0;

  constructor(view, host, names) {
    this.#view = view;
    this.#host = host;
    this.#env = view.create();
    this.#players = Object.fromEntries(view.players.map((name) => [name, new Player(host, name)]));
    this.#build(names);
    this.#watch();
    this.#begin();
  }

  /** Simulated seconds since the last reset. */
  get seconds() {
    return this.#tally.steps * this.#view.stepSeconds;
  }

  play() {
    this.#pause(false);
  }

  // ---- the elements -------------------------------------------------------------------------------------------------

  #build(names) {
    const view = this.#view;
    const button = (name, words, action) => {
      this.#parts[name] = h("button", { type: "button", id: name, onclick: action }, words);
      return this.#parts[name];
    };
    const speed = h("select", { id: "speed" }, SPEEDS.map((n) => h("option", { value: n, selected: n === 1 }, `${n} ×`)));
    const exact = h("input", { type: "checkbox", id: "exact", checked: true });
    exact.addEventListener("change", () => {
      for (const player of Object.values(this.#players)) player.deterministic = exact.checked;
    });
    const canvas = h("canvas", { id: "canvas", role: "img", "aria-label": view.name });
    Object.assign(this.#parts, { speed, canvas, status: h("p", { id: "status", class: "status" }) });
    $("scene").append(
      h("h2", { id: "scene-title" }, `At work in ${view.name}`),
      h("p", { class: "lead" }, view.story),
      h(
        "div",
        { class: "columns" },
        h(
          "div",
          { class: "stage" },
          canvas,
          this.#parts.status,
          h(
            "div",
            { class: "controls" },
            button("pause", "Play", () => this.#pause(!this.#paused)),
            button("step", "Step", () => this.#stepOnce()),
            button("reset", "Reset", () => this.#queued(() => this.#begin())),
            view.poke && button("poke", view.poke, () => this.#queued(() => this.#poke())),
            h("span", { class: "field" }, h("label", { for: "speed" }, "Speed"), speed),
            h("span", { class: "field" }, exact, h("label", { for: "exact" }, "Deterministic")),
          ),
        ),
        h("div", { class: "numbers" }, this.#chooser(), this.#numbers(names)),
      ),
    );
    $("scene").hidden = false;
  }

  #chooser() {
    if (this.#view.agents === 1) return null;
    const select = h("select", { id: "agent" }, Array.from({ length: this.#view.agents }, (_, i) => h("option", { value: i }, `${i + 1}`)));
    select.addEventListener("change", () => {
      this.#chosen = Number(select.value);
      this.#shown = { numbers: 0, text: 0 };
    });
    return h("p", { class: "field" }, h("label", { for: "agent" }, "Agent shown"), select);
  }

  #numbers(names) {
    const { contract } = this.#host.policy();
    const [spec] = this.#host.policy().observations;
    this.#bars.seen = new Bars("It sees", names.observation(spec, spec.shape.at(-1)));
    if (contract.action_space === "continuous") {
      this.#bars.acts = new Bars("It does", names.continuous(contract.outputs[0].shape.at(-1)));
    } else {
      this.#bars.chances = contract.branches.map((count, i) => {
        return new Bars(contract.branches.length > 1 ? `It chooses, branch ${i}` : "It chooses", names.branch(i, count), { from: "left" });
      });
    }
    return [this.#bars.seen, this.#bars.acts, ...(this.#bars.chances ?? [])].filter(Boolean).map(({ element }) => element);
  }

  #watch() {
    const canvas = this.#parts.canvas;
    const fit = () => {
      const width = canvas.clientWidth;
      const height = Math.round(width / this.#view.ratio(width));
      const density = Math.min(window.devicePixelRatio || 1, 2);
      canvas.style.aspectRatio = `${width} / ${height}`;
      [canvas.width, canvas.height] = [Math.round(width * density), Math.round(height * density)];
      this.#draw(1);
    };
    const recolour = () => {
      this.#colours = palette(canvas);
      if (this.#after) this.#draw(1);
    };
    recolour();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
    new ResizeObserver(() => this.#after && fit()).observe(canvas);
  }

  // ---- the simulation -----------------------------------------------------------------------------------------------

  #begin() {
    this.#observation = this.#env.reset(this.#seed++);
    Object.values(this.#players).forEach((player) => player.forget());
    this.#tally = { good: 0, bad: 0, best: 0, missed: [0, 0], steps: 0 };
    this.#before = null;
    this.#after = this.#env.snapshot();
    this.#decision = null;
    this.#shown = { numbers: 0, text: 0 };
    this.#tell();
    if (this.#parts.canvas.width > 0) this.#draw(1);
  }

  #poke() {
    if (this.#view.pokes === "memory") Object.values(this.#players).forEach((player) => player.forget());
    else {
      this.#env.poke();
      this.#observation = this.#env.observe(this.#env.isFirst);
      this.#after = this.#env.snapshot();
    }
  }

  /** Steps and what a visitor does come one after the other. */
  #queued(job) {
    this.#busy = this.#busy.then(job);
    return this.#busy;
  }

  async #step() {
    const decisions = {};
    for (const [name, player] of Object.entries(this.#players)) {
      decisions[name] = await player.act(this.#view.observed(this.#observation, name), this.#env.isFirst);
    }
    this.#decision = { ...decisions.model, seen: this.#view.observed(this.#observation, "model") };
    this.#before = this.#after;
    const { observation, rewards, terminated, truncated, success } = this.#env.step(this.#view.actions(decisions, this.#observation));
    this.#observation = observation;
    this.#after = this.#env.snapshot();
    const tally = this.#tally;
    tally.steps += 1;
    terminated.forEach((ended, i) => {
      if (ended || truncated[i]) tally[success[i] ? "good" : "bad"] += 1;
      if (Array.isArray(rewards[i])) rewards[i].forEach((reward, side) => (tally.missed[side] += Number(reward < 0)));
    });
    if (this.#after.rally) tally.best = Math.max(tally.best, ...this.#after.rally);
  }

  async #stepOnce() {
    this.#pause(true);
    await this.#queued(() => this.#step());
    this.#shown = { numbers: 0, text: 0 };
    this.#tell();
    this.#draw(1);
  }

  #pause(paused) {
    if (paused === this.#paused) return;
    this.#paused = paused;
    this.#parts.pause.textContent = paused ? "Play" : "Pause";
    if (!paused) void this.#run();
  }

  async #run() {
    const own = ++this.#loop;
    let [last, behind] = [performance.now(), 0];
    try {
      while (!this.#paused && own === this.#loop) {
        await frame();
        const now = performance.now();
        const speed = Number(this.#parts.speed.value);
        behind = Math.min(behind + ((now - last) / 1000) * speed, MOST_BEHIND * speed + this.#view.stepSeconds);
        last = now;
        for (let n = 0; n < STEPS_A_FRAME && behind >= this.#view.stepSeconds; n++) {
          await this.#queued(() => this.#step());
          behind -= this.#view.stepSeconds;
        }
        this.#draw(Math.min(behind / this.#view.stepSeconds, 1));
        this.#tell();
      }
    } catch (error) {
      this.#pause(true);
      this.#parts.status.textContent = `The policy cannot act: ${error.message}`;
    }
  }

  // ---- what is shown ------------------------------------------------------------------------------------------------

  #draw(share) {
    const { canvas } = this.#parts;
    const context = canvas.getContext("2d");
    const density = canvas.width / Math.max(canvas.clientWidth, 1);
    const size = { width: canvas.width / density, height: canvas.height / density };
    context.setTransform(density, 0, 0, density, 0, 0);
    context.clearRect(0, 0, size.width, size.height);
    this.#view.draw(context, size, this.#before, this.#after, share, this.#colours, this.#view.agents > 1 ? this.#chosen : -1);
  }

  #tell() {
    const now = performance.now();
    if (now - this.#shown.numbers > NUMBERS_EVERY || this.#shown.numbers === 0) {
      this.#shown.numbers = now;
      const time = this.#view.stepSeconds < 0.1 ? `${this.seconds.toFixed(1)} s` : `${this.#tally.steps} steps`;
      this.#parts.status.textContent = `${this.#view.status(this.#env, this.#tally)} · ${time} played`;
      Object.assign(this.#parts.status.dataset, { seconds: this.seconds, good: this.#tally.good, bad: this.#tally.bad });
      this.#showNumbers();
    }
    if (now - this.#shown.text > TEXT_EVERY || this.#shown.text === 0) {
      this.#shown.text = now;
      this.#parts.canvas.setAttribute("aria-label", this.#view.describe(this.#env, this.#tally, this.#chosen));
    }
  }

  #showNumbers() {
    const decision = this.#decision;
    const i = this.#chosen;
    this.#bars.seen.show((decision?.seen ?? this.#view.observed(this.#observation, "model")).state[i]);
    if (decision === null) return;
    this.#bars.acts?.show(decision.continuous[i]);
    const shares = this.#bars.chances && probabilities(this.#host.policy().contract, decision.outputs, i);
    this.#bars.chances?.forEach((bars, branch) => {
      const chosen = decision.discrete[i][branch];
      bars.show(shares?.[branch] ?? [], { chosen, write: (v) => (v === undefined ? "" : percent(v)) });
    });
  }
}
