/**
 * Hallway: a cue at the start says which of two doors at the far end is the right one. It takes memory.
 * The same as exporter/play/environments/hallway.py.
 */

import { Environment } from "./base.mjs";

export const LONGEST = 8;
export const LEFT = 1;
const SHORTEST = 4;
const FORWARD = 0;
const RIGHT = 2;
const RIGHT_DOOR = 1;
const WRONG_DOOR = -1;
const STEP = -0.01;

/** `door` is 1 for left and 2 for right, `ahead` the steps to the doors, `before` the last action. */
export class Hallway extends Environment {
  constructor(agents) {
    super(agents, { maxSteps: 40, lasting: false });
  }

  allocate() {
    [this.door, this.ahead, this.before, this.length] = [[], [], [], []];
    /** Where the last episode ended, for the drawing: 1 left, 2 right, and whether that was right; null in between. */
    this.went = new Array(this.agents).fill(null);
  }

  begin(i) {
    this.door[i] = LEFT + Math.floor(this.draw(i) * 2);
    this.ahead[i] = SHORTEST + Math.floor(this.draw(i) * (LONGEST - SHORTEST + 1));
    this.length[i] = this.ahead[i];
    this.before[i] = FORWARD;
  }

  advance(i, { discrete }) {
    const [action] = discrete[i];
    const atDoors = this.ahead[i] === 0;
    const ended = atDoors && action !== FORWARD;
    const won = action === this.door[i];
    if (!atDoors && action === FORWARD) this.ahead[i] -= 1;
    this.before[i] = action;
    this.went[i] = ended ? { side: action, won } : null;
    return { reward: ended ? (won ? RIGHT_DOOR : WRONG_DOOR) : STEP, ended, won };
  }

  observe(isFirst) {
    const state = this.ahead.map((ahead, i) => {
      const cues = [LEFT, RIGHT].map((side) => Number(isFirst[i] && this.door[i] === side));
      return [...cues, Math.fround(ahead / LONGEST), Number(ahead === 0)];
    });
    return { state, masks: state.map(() => [1, 1, 1]), previous: this.before.map((action) => [action]) };
  }

  snapshot() {
    const { door, ahead, length, went, age, isFirst } = this;
    return structuredClone({ door, ahead, length, went, age, isFirst });
  }
}
