/** Tennis: two brains keep a ball in play. The same as exporter/play/environments/tennis.py. */

import { Environment, chance, clip, pairs } from "./base.mjs";

export const TIME_STEP = 0.05; // s
export const HALF_RACKET = 0.2; // m
const BALL_SPEED = 1; // m/s along x, always
const MAX_SLANT = 1.2; // m/s along y
const RACKET_SPEED = 0.8; // m/s
const DEFLECTION = 0.8; // m/s along y for a ball that is hit with the end of the racket
const CHANCE = 0.4; // m/s along y, at most, that a hit adds
const SERVE_SLANT = 0.8; // m/s, at most
const RETURN = 0.1;
const MISS = -1;

/** `racket` has y of left and right; `ball` and `velocity` have x and y. */
export class Tennis extends Environment {
  constructor(agents) {
    super(agents, { maxSteps: 1000, lasting: true });
  }

  allocate() {
    [this.racket, this.ball, this.velocity] = [pairs(this.agents), pairs(this.agents), pairs(this.agents)];
    /** Returns in a row, for the score. */
    this.rally = new Array(this.agents).fill(0);
  }

  begin(i) {
    [this.racket[i], this.ball[i], this.rally[i]] = [[0, 0], [0, 0], 0];
    this.velocity[i] = [this.draw(i) < 0.5 ? -BALL_SPEED : BALL_SPEED, this.draw(i, -SERVE_SLANT, SERVE_SLANT)];
  }

  /** `discrete` is the left brain's, `continuous` the right one's. */
  advance(i, { discrete, continuous }) {
    const drive = [[0, 1, -1][discrete[i][0]], clip(continuous[i][0], -1, 1)];
    const [racket, ball, velocity] = [this.racket[i], this.ball[i], this.velocity[i]];
    drive.forEach((way, side) => {
      racket[side] = clip(racket[side] + RACKET_SPEED * TIME_STEP * way, -1, 1);
    });
    ball[0] += TIME_STEP * velocity[0];
    ball[1] += TIME_STEP * velocity[1];
    if (Math.abs(ball[1]) > 1) {
      ball[1] = Math.sign(ball[1]) * 2 - ball[1];
      velocity[1] = -velocity[1];
    }
    const side = velocity[0] < 0 ? 0 : 1;
    const arrives = Math.abs(ball[0]) > 1 - 0.5 * BALL_SPEED * TIME_STEP;
    const offset = ball[1] - racket[side];
    const returned = arrives && Math.abs(offset) <= HALF_RACKET;
    const missed = arrives && !returned;
    if (returned) {
      const slant = (DEFLECTION * offset) / HALF_RACKET + this.draw(i, -CHANCE, CHANCE);
      velocity[1] = clip(slant, -MAX_SLANT, MAX_SLANT);
      velocity[0] = -velocity[0];
      this.rally[i] += 1;
    }
    const reward = [0, 0];
    if (arrives) reward[side] = returned ? RETURN : MISS;
    return { reward, ended: missed, won: false };
  }

  /** Each brain sees the court from its own side. */
  observe() {
    const rounded = (row) => row.map(Math.fround);
    const left = this.ball.map(([x, y], i) => {
      return rounded([this.racket[i][0], x + 1, y, -this.velocity[i][0], this.velocity[i][1]]);
    });
    const right = this.ball.map(([x, y], i) => {
      return rounded([this.racket[i][1], 1 - x, y, this.velocity[i][0], this.velocity[i][1]]);
    });
    const masks = this.racket.map(([y]) => [1, Number(y < 1), Number(y > -1)]);
    return { left: { state: left, masks }, right: { state: right } };
  }

  /** A visitor deflects the ball. */
  poke(random) {
    for (const velocity of this.velocity) velocity[1] = clip(velocity[1] + chance(random), -MAX_SLANT, MAX_SLANT);
  }

  snapshot() {
    return structuredClone({ racket: this.racket, ball: this.ball, rally: this.rally, age: this.age });
  }
}

/** A player without a policy: its racket goes where the ball is. */
export function follow(side, { state }) {
  const ways = state.map(([racket, , ball]) => ball - racket);
  if (side === "left") return { discrete: ways.map((way) => [Math.abs(way) < 0.04 ? 0 : way > 0 ? 1 : 2]) };
  return { continuous: ways.map((way) => [clip(way * 10, -1, 1)]) };
}
