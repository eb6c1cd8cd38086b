/** GridWorld: walk to the goal and around the pit. The same as exporter/play/environments/gridworld.py. */

import { Environment } from "./base.mjs";

export const SIZE = 5;
export const WALLS = [[1, 3], [2, 3], [3, 1]];
const MOVES = [[0, 1], [1, 0], [0, -1], [-1, 0]]; // up, right, down, left
const GOAL = 1;
const PIT = -1;
const STEP = -0.01;

const same = (a, b) => a[0] === b[0] && a[1] === b[1];
const cells = Array.from({ length: SIZE * SIZE }, (_, n) => [n % SIZE, Math.floor(n / SIZE)]);
/** All cells that are no wall, row by row from below. */
const FREE = cells.filter((cell) => !WALLS.some((wall) => same(wall, cell)));
const open = (cell) => MOVES.map(([dx, dy]) => FREE.some((free) => same(free, [cell[0] + dx, cell[1] + dy])));

/** `agent`, `goal`, `pit` are [column, row], for each agent. */
export class GridWorld extends Environment {
  constructor(agents) {
    super(agents, { maxSteps: 50, lasting: false });
  }

  allocate() {
    [this.agent, this.goal, this.pit] = [[], [], []];
  }

  begin(i) {
    // Three different numbers: each is drawn from those that are left, then counted past the ones that are taken.
    const first = Math.floor(this.draw(i) * FREE.length);
    let second = Math.floor(this.draw(i) * (FREE.length - 1));
    if (second >= first) second += 1;
    let third = Math.floor(this.draw(i) * (FREE.length - 2));
    if (third >= Math.min(first, second)) third += 1;
    if (third >= Math.max(first, second)) third += 1;
    [this.agent[i], this.goal[i], this.pit[i]] = [FREE[first], FREE[second], FREE[third]];
  }

  advance(i, { discrete }) {
    const [move] = discrete[i];
    const at = this.agent[i];
    if (open(at)[move]) this.agent[i] = [at[0] + MOVES[move][0], at[1] + MOVES[move][1]];
    const [atGoal, inPit] = [same(this.agent[i], this.goal[i]), same(this.agent[i], this.pit[i])];
    return { reward: atGoal ? GOAL : inPit ? PIT : STEP, ended: atGoal || inPit, won: atGoal };
  }

  observe() {
    const middle = Math.floor(SIZE / 2);
    const state = this.agent.map((at, i) => {
      return [...at, ...this.goal[i], ...this.pit[i]].map((n) => Math.fround(n / middle - 1));
    });
    return { state, masks: this.agent.map((at) => open(at).map(Number)) };
  }

  /** A visitor puts the goal somewhere, if that is free. */
  hold(i, cell) {
    const taken = [this.agent[i], this.pit[i]].some((other) => same(other, cell));
    if (!taken && FREE.some((free) => same(free, cell))) this.goal[i] = [...cell];
  }

  push(i, cell) {
    this.hold(i, cell);
  }

  /** A visitor moves the goals, each to a cell that is free. */
  poke(random) {
    this.goal.forEach((old, i) => {
      const left = FREE.filter((cell) => ![old, this.agent[i], this.pit[i]].some((taken) => same(taken, cell)));
      this.goal[i] = left[Math.floor(random() * left.length)];
    });
  }

  snapshot() {
    return structuredClone({ agent: this.agent, goal: this.goal, pit: this.pit, age: this.age });
  }
}
