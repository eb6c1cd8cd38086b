/** A visitor's hand on a scene: what is grabbed follows the pointer, flies on when it is let go, and is pushed by a click. */

const CLICK = 250; // ms
const FAR = 6; // pixels, from which on it is a drag
const FLICK = 80; // ms, over which the pointer's speed counts

export class Hand {
  #held = null;
  #trail = [];

  /**
   * @param {{lane: () => object, change: (what: (env: object) => void) => void, poke: () => void, choose: (i: number) => void}} stage
   */
  constructor(canvas, view, stage) {
    this.canvas = canvas;
    this.view = view;
    this.stage = stage;
    canvas.classList.toggle("grabbable", view.at !== undefined);
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    canvas.addEventListener("pointerup", (event) => this.#up(event));
    canvas.addEventListener("pointercancel", () => (this.#held = null));
  }

  /** After each step: what is held stays where the hand is. */
  hold() {
    if (this.#held?.dragged) this.stage.change((env) => env.hold(this.#held.agent, this.#held.place));
  }

  #point(event) {
    const box = this.canvas.getBoundingClientRect();
    return [{ width: box.width, height: box.height }, [event.clientX - box.left, event.clientY - box.top]];
  }

  #down(event) {
    const [size, point] = this.#point(event);
    const found = this.view.at?.(size, this.stage.lane().after, point);
    if (found === undefined || found === null) {
      if (this.view.at === undefined && this.view.poke) this.stage.poke();
      return;
    }
    this.canvas.setPointerCapture(event.pointerId);
    this.stage.choose(found.agent);
    this.#held = { ...found, begin: performance.now(), from: point, dragged: false };
    this.#trail = [{ at: this.#held.begin, place: found.place }];
  }

  #move(event) {
    if (this.#held === null) return;
    const [size, point] = this.#point(event);
    this.#held.dragged ||= Math.hypot(point[0] - this.#held.from[0], point[1] - this.#held.from[1]) > FAR;
    this.#held.place = this.view.at(size, this.stage.lane().after, point, this.#held.agent).place;
    const now = performance.now();
    // The place before this one counts however old it is: a busy machine may report one move in all.
    const recent = this.#trail.filter(({ at }, k) => now - at < FLICK || k === this.#trail.length - 1);
    this.#trail = [...recent, { at: now, place: this.#held.place }];
    this.hold();
  }

  #up() {
    const held = this.#held;
    this.#held = null;
    if (held === null) return;
    if (!held.dragged) {
      if (performance.now() - held.begin < 4 * CLICK) this.stage.change((env) => env.push(held.agent, held.place));
      return;
    }
    const [first, last] = [this.#trail[0], this.#trail.at(-1)];
    const seconds = Math.max((performance.now() - first.at) / 1000, 0.01);
    const speed = last.place.map((end, k) => (end - first.place[k]) / seconds);
    this.stage.change((env) => env.release?.(held.agent, speed));
  }
}
