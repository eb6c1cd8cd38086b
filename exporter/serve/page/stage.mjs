/** A scene: the environment is simulated, the policy acts in it, and both are drawn; beside it another, from the same seed. */

import { droppable, dropped, fitting, untrained } from "./beside.mjs";
import { Bars, Divergence, percent } from "./charts.mjs";
import { $, frame, h } from "./dom.mjs";
import { canRecord, Film } from "./film.mjs";
import { Hand } from "./hand.mjs";
import { apart, Lane } from "./lane.mjs";
import { asked, tell } from "./link.mjs";
import { engine } from "./names.mjs";
import { probabilities } from "./player.mjs";
import { Streams } from "./scenes/base.mjs";
import { palette } from "./views/drawing.mjs";

const SPEEDS = [0.25, 0.5, 1, 2, 4, 8];
/** A page that was held up goes on from where it is, and does not rush. */
const MOST_BEHIND = 0.25; // s
const STEPS_A_FRAME = 12;
/** How often numbers and the text for screen readers change, in ms. */
const NUMBERS_EVERY = 100;
const TEXT_EVERY = 2000;
/** Until somebody touches the scene, something happens in it by itself: every so many seconds. */
const GUST_EVERY = 5;
/** What stands beside the policy until somebody chooses something else. */
const UNTRAINED = "untrained";

export class Stage {
  #view;
  #host;
  #lanes;
  #chosen = 0;
  #paused = true;
  #seed = Math.trunc(Math.abs(Number(asked("seed")))) || 0;
  #parts = { canvases: [] };
  #bars = {};
  #shown = { numbers: 0, text: 0 };
  #colours;
  #busy = Promise.resolve();
  /** The loop that runs; one that was paused and has not noticed yet is another. */
  #loop = 0;
  #touched = false;
  #moved;
  #gust = GUST_EVERY;
  #film = null;
  #beside = null;
  #large;

  /** @param {{name: string, script: string | null, large?: boolean}[]} backends */
  constructor(view, host, names, backends) {
    this.#view = view;
    this.#host = host;
    this.#large = backends.find(({ large }) => large);
    this.#lanes = [new Lane(view, this.#policies())];
    this.#build(names, backends);
    this.#colours = palette($("scene"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      this.#colours = palette($("scene"));
      this.#draw(1);
    });
    this.#begin();
    const other = asked("beside") ?? UNTRAINED;
    if (backends.some(({ name }) => name === other) || other === UNTRAINED) void this.#compare(other);
  }

  /** Simulated seconds since the last reset. */
  get seconds() {
    return this.#lanes[0].tally.steps * this.#view.stepSeconds;
  }

  /** Resolves when the scene has moved, or will not. */
  play() {
    return new Promise((resolve) => {
      this.#moved = resolve;
      this.#pause(false);
    });
  }

  #policies() {
    return Object.fromEntries(this.#view.players.map((name) => [name, () => this.#host.policy(name)]));
  }

  // ---- the elements -------------------------------------------------------------------------------------------------

  #build(names, backends) {
    const view = this.#view;
    const button = (name, words, action) => {
      this.#parts[name] = h("button", { type: "button", id: name, onclick: action }, words);
      return this.#parts[name];
    };
    const start = SPEEDS.includes(Number(asked("speed"))) ? Number(asked("speed")) : 1;
    const speed = h("select", { id: "speed", onchange: () => tell("speed", speed.value) });
    speed.append(...SPEEDS.map((n) => h("option", { value: n, selected: n === start }, `${n} ×`)));
    const exact = h("input", { type: "checkbox", id: "exact", checked: true });
    exact.addEventListener("change", () => this.#players().forEach((player) => (player.deterministic = exact.checked)));
    const beside = h("select", { id: "beside", onchange: () => void this.#compare(beside.value) });
    const others = [[UNTRAINED, "itself, untrained"], ["", "nothing"], ...backends.map(({ name }) => [name, `itself, on ${engine(name)}`])];
    beside.append(...others.map(([value, words]) => h("option", { value }, words)));
    const lanes = h("div", { class: "lanes" });
    const divergence = new Divergence();
    const said = h("p", { id: "said", class: "soft", role: "status" });
    Object.assign(this.#parts, { speed, exact, beside, lanes, divergence, said });
    $("scene").append(
      h("h2", { id: "scene-title", class: "hidden" }, `At work in ${view.name}`),
      h(
        "div",
        { class: "stage" },
        lanes,
        h(
          "div",
          { class: "controls" },
          button("pause", "Play", () => this.#pause(!this.#paused)),
          button("step", "Step", () => this.#stepOnce()),
          button("reset", "Reset", () => this.#queued(() => this.#begin(this.#seed + 1))),
          view.poke && button("poke", view.poke, () => this.#queued(() => this.#poke())),
          h("span", { class: "field" }, h("label", { for: "speed" }, "Speed"), speed),
          h("span", { class: "field" }, exact, h("label", { for: "exact" }, "Deterministic")),
          h("span", { class: "field" }, h("label", { for: "beside" }, "Compare with"), beside),
          button("copy", "Copy link", () => this.#copy()),
          canRecord() && button("record", "Record", () => this.#record()),
        ),
        said,
        h("p", {}, view.story),
        h("p", { class: "soft", id: "droppable" }, droppable(new Set(backends.map(({ name }) => name)))),
        divergence.element,
      ),
      h("div", { class: "numbers side-by-side" }, this.#chooser(), this.#numbers(names)),
    );
    this.#addCanvas();
    const touch = () => (this.#touched = true);
    for (const event of ["pointerdown", "keydown", "change"]) $("scene").addEventListener(event, touch);
    this.#takeDrops();
    $("scene").hidden = false;
  }

  /** A canvas and a line of text for a lane; the first ones' ids are "canvas" and "status". */
  #addCanvas() {
    const number = this.#parts.canvases.length;
    const id = (name) => (number === 0 ? name : `${name}-${number + 1}`);
    const canvas = h("canvas", { id: id("canvas"), class: "scene", role: "img", "aria-label": this.#view.name });
    const status = h("p", { id: id("status"), class: "status" });
    const title = h("span", { class: "title" });
    const count = h("span", { class: "count" });
    const element = h("div", { class: "lane" }, h("p", { class: "heading" }, title, count), canvas, status);
    const fit = () => {
      const width = canvas.clientWidth;
      const height = Math.round(width / this.#view.ratio(width));
      const density = Math.min(window.devicePixelRatio || 1, 2);
      canvas.style.aspectRatio = `${width} / ${height}`;
      [canvas.width, canvas.height] = [Math.round(width * density), Math.round(height * density)];
      this.#draw(1);
    };
    this.#parts.canvases.push({ canvas, status, title, count, element });
    this.#parts.lanes.append(element);
    new ResizeObserver(() => canvas.clientWidth > 0 && fit()).observe(canvas);
    const hand = new Hand(canvas, this.#view, {
      lane: () => this.#lanes[number],
      change: (what) => void this.#queued(() => this.#changed(what)),
      poke: () => this.#queued(() => this.#poke()),
      choose: (i) => this.#choose(i),
    });
    this.#parts.canvases[number].hand = hand;
  }

  #chooser() {
    if (this.#view.agents === 1) return null;
    const select = h("select", { id: "agent" }, Array.from({ length: this.#view.agents }, (_, i) => h("option", { value: i }, `${i + 1}`)));
    select.addEventListener("change", () => this.#choose(Number(select.value)));
    this.#parts.agent = select;
    return h("p", { class: "field" }, h("label", { for: "agent" }, "Agent shown"), select);
  }

  #choose(i) {
    this.#chosen = i;
    if (this.#parts.agent) this.#parts.agent.value = i;
    this.#shown = { numbers: 0, text: 0 };
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

  // ---- side by side -------------------------------------------------------------------------------------------------

  /** Puts another policy beside this one: "untrained", a backend's name, "" for none; or a policy that was dropped. */
  async #compare(what, given = null) {
    this.#say("");
    this.#parts.beside.value = given === null ? what : "";
    try {
      const policy = given ?? (await this.#other(what));
      await this.#queued(() => {
        this.#lanes.length = 1;
        this.#beside = policy === null ? null : { what, name: given?.name ?? what };
        if (policy !== null) this.#lanes.push(new Lane(this.#view, { ...this.#policies(), model: () => policy }));
        if (this.#parts.canvases.length < 2 && policy !== null) this.#addCanvas();
        this.#players().forEach((player) => (player.deterministic = this.#parts.exact.checked));
        this.#begin();
      });
      tell("beside", given !== null || what === UNTRAINED ? null : what || "nothing");
    } catch (error) {
      this.#parts.beside.value = this.#beside?.what ?? "";
      this.#say(`It cannot be compared: ${error.message}.`);
    }
  }

  async #other(what) {
    if (what === "") return null;
    return what === UNTRAINED ? untrained(this.#host.source()) : this.#host.policyOn(what);
  }

  #takeDrops() {
    document.addEventListener("dragover", (event) => event.preventDefault());
    document.addEventListener("drop", async (event) => {
      event.preventDefault();
      try {
        const policy = await dropped(event.dataTransfer.items, this.#large?.script);
        fitting(this.#host.policy().contract, policy.contract);
        await this.#compare("", policy);
      } catch (error) {
        this.#say(`What was dropped cannot be shown: ${error.message}.`);
      }
    });
  }

  async #copy() {
    tell("seed", this.#seed);
    try {
      await navigator.clipboard.writeText(location.href);
      this.#say("Link copied. It opens this seed, speed and comparison.");
    } catch {
      this.#say(`The link: ${location.href}`);
    }
  }

  async #record() {
    if (this.#film === null) {
      this.#film = new Film(this.#canvases().map(({ canvas }) => canvas), this.#colours.sheet);
      this.#parts.record.textContent = "Stop and save";
      this.#pause(false);
      return;
    }
    const film = this.#film;
    this.#film = null;
    this.#parts.record.textContent = "Record";
    await film.save(`${this.#host.policy().name}.webm`);
  }

  #say(words) {
    this.#parts.said.textContent = words;
  }

  // ---- the simulation -----------------------------------------------------------------------------------------------

  #players() {
    return this.#lanes.flatMap(({ players }) => Object.values(players));
  }

  #canvases() {
    return this.#parts.canvases.slice(0, this.#lanes.length);
  }

  #begin(seed = this.#seed) {
    this.#seed = seed;
    this.#lanes.forEach((lane) => lane.begin(seed));
    this.#gust = GUST_EVERY;
    this.#parts.divergence.clear();
    this.retitle();
    this.#shown = { numbers: 0, text: 0 };
    this.#tell();
    this.#draw(1);
  }

  /** Says which policy is which. */
  retitle() {
    this.#parts.canvases.forEach(({ element, title }, i) => {
      element.hidden = i >= this.#lanes.length;
      title.textContent = i === 0 ? this.#ownTitle() : this.#titled();
    });
    this.#parts.divergence.element.hidden = this.#lanes.length === 1;
  }

  #ownTitle() {
    const what = this.#beside?.what ?? UNTRAINED;
    return what === UNTRAINED || what === "" ? "Trained" : `On ${engine(this.#host.backend)}`;
  }

  #titled() {
    if (this.#beside === null) return "";
    const { what, name } = this.#beside;
    return what === UNTRAINED ? "Untrained" : what === "" ? `${name} (dropped here)` : `On ${engine(name)}`;
  }

  #poke() {
    const seed = Math.floor(Math.random() * 2 ** 32);
    for (const lane of this.#lanes) {
      if (this.#view.pokes === "memory") lane.forget();
      else {
        const random = new Streams(seed, 1); // what happens to one happens to the other
        lane.change((env) => env.poke(() => random.uniform(0)));
      }
    }
  }

  #changed(what) {
    this.#lanes.forEach((lane) => lane.change(what));
    if (!this.#paused) return;
    this.#shown = { numbers: 0, text: 0 };
    this.#tell();
    this.#draw(1);
  }

  /** Steps and what a visitor does come one after the other; one that fails holds up no other. */
  #queued(job) {
    const done = this.#busy.then(job);
    this.#busy = done.catch(() => {});
    return done;
  }

  async #step() {
    for (const lane of this.#lanes) await lane.step();
    for (const { hand } of this.#canvases()) hand.hold();
    if (this.#lanes.length > 1) this.#parts.divergence.add(this.seconds, ...apart(...this.#lanes));
    this.#gust -= this.#view.stepSeconds;
    if (this.#gust <= 0 && !this.#touched && this.#view.gusts) {
      this.#poke();
      this.#gust = GUST_EVERY;
    }
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
    let [last, behind] = [performance.now(), this.#view.stepSeconds]; // it moves in the first frame
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
        this.#hasMoved();
      }
    } catch (error) {
      this.#pause(true);
      this.#parts.canvases[0].status.textContent = `The policy cannot act: ${error.message}`;
    }
    this.#moved?.();
  }

  /** What else the page does can wait until then. */
  #hasMoved() {
    if (this.#moved === undefined) return;
    performance.mark("first-movement");
    this.#moved();
    this.#moved = undefined;
  }

  // ---- what is shown ------------------------------------------------------------------------------------------------

  #draw(share) {
    this.#canvases().forEach(({ canvas }, i) => {
      if (canvas.width === 0) return;
      const context = canvas.getContext("2d");
      const density = canvas.width / Math.max(canvas.clientWidth, 1);
      const size = { width: canvas.width / density, height: canvas.height / density };
      context.setTransform(density, 0, 0, density, 0, 0);
      context.clearRect(0, 0, size.width, size.height);
      const { before, after } = this.#lanes[i];
      this.#view.draw(context, size, before, after, share, this.#colours, this.#view.agents > 1 ? this.#chosen : -1);
    });
    if (this.#lanes.length > 1) this.#parts.divergence.draw();
    this.#film?.frame();
  }

  #tell() {
    const now = performance.now();
    if (now - this.#shown.numbers > NUMBERS_EVERY || this.#shown.numbers === 0) {
      this.#shown.numbers = now;
      const time = this.#view.stepSeconds < 0.1 ? `${this.seconds.toFixed(1)} s` : `${this.#lanes[0].tally.steps} steps`;
      this.#canvases().forEach(({ status, count }, i) => {
        const { env, tally } = this.#lanes[i];
        count.textContent = this.#view.count(tally, env);
        const failed = this.#view.failed?.(tally) ?? tally.bad;
        count.classList.toggle("fail", failed > 0);
        count.classList.toggle("ok", failed === 0 && i === 0);
        status.textContent = `${this.#view.status(env, tally)} · ${time} played`;
        Object.assign(status.dataset, { seconds: this.seconds, good: tally.good, bad: tally.bad });
      });
      this.#showNumbers();
    }
    if (now - this.#shown.text > TEXT_EVERY || this.#shown.text === 0) {
      this.#shown.text = now;
      this.#canvases().forEach(({ canvas }, i) => {
        canvas.setAttribute("aria-label", this.#view.describe(this.#lanes[i].env, this.#lanes[i].tally, this.#chosen));
      });
    }
  }

  #showNumbers() {
    const { decision } = this.#lanes[0];
    const i = this.#chosen;
    const seen = this.#paused ? this.#lanes[0].seen() : (decision?.seen ?? this.#lanes[0].seen());
    this.#bars.seen.show(seen.state[i]);
    if (decision === null) return;
    this.#bars.acts?.show(decision.continuous[i]);
    const shares = this.#bars.chances && probabilities(this.#host.policy().contract, decision.outputs, i);
    this.#bars.chances?.forEach((bars, branch) => {
      const chosen = decision.discrete[i][branch];
      bars.show(shares?.[branch] ?? [], { chosen, write: (v) => (v === undefined ? "" : percent(v)) });
    });
  }
}
