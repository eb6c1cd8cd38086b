/** 3DBall: keep a ball on a platform that can be tilted about two axes. The same as exporter/play/environments/ball3d.py. */

import { Environment, chance, clip, pairs } from "./base.mjs";

export const TIME_STEP = 0.02; // s
export const HALF_SIDE = 2.5; // m, of the platform
export const RADIUS = 0.5; // m, of the ball
const GRAVITY = 9.81; // m/s²
const ROLLING = 5 / 7; // of a solid sphere
const MAX_TILT = 0.25; // rad
const TURN = 2 * (Math.PI / 180); // rad a step, at action 1
const START_TILT = 10 * (Math.PI / 180);
const START_POSITION = 1.5; // m
const START_SPEED = 0.5; // m/s
const PUSH = 1.6; // m/s, of a visitor
const THROW = 5; // m/s, at most
const DOWNHILL = [-1, 1];

/** `tilt` is about z and x, `position` and `velocity` along x and z; a pair per agent. */
export class Ball3D extends Environment {
  constructor(agents) {
    super(agents, { maxSteps: 1000, lasting: true });
  }

  allocate() {
    [this.tilt, this.position, this.velocity] = [pairs(this.agents), pairs(this.agents), pairs(this.agents)];
  }

  begin(i) {
    const starts = [[this.tilt, START_TILT], [this.position, START_POSITION], [this.velocity, START_SPEED]];
    for (const [pair, bound] of starts) pair[i] = [this.draw(i, -bound, bound), this.draw(i, -bound, bound)];
  }

  advance(i, { continuous }) {
    for (const axis of [0, 1]) {
      const turn = clip(continuous[i][axis], -1, 1) * TURN;
      this.tilt[i][axis] = clip(this.tilt[i][axis] + turn, -MAX_TILT, MAX_TILT);
      const downhill = Math.sin(this.tilt[i][axis]) * DOWNHILL[axis];
      this.velocity[i][axis] += ROLLING * GRAVITY * TIME_STEP * downhill;
      this.position[i][axis] += TIME_STEP * this.velocity[i][axis];
    }
    const ended = this.position[i].some((p) => Math.abs(p) > HALF_SIDE);
    return { reward: ended ? -1 : 0.1, ended, won: false };
  }

  observe() {
    const state = this.tilt.map((tilt, i) => {
      const slope = [Math.tan(tilt[0]), -Math.tan(tilt[1])];
      const [[x, z], [vx, vz]] = [this.position[i], this.velocity[i]];
      const [height, climb] = [RADIUS + (x * slope[0] + z * slope[1]), vx * slope[0] + vz * slope[1]];
      return [...tilt, x, height, z, vx, climb, vz].map(Math.fround);
    });
    return { state };
  }

  /** A visitor's push. */
  poke(random) {
    for (const velocity of this.velocity) {
      velocity[0] += PUSH * chance(random);
      velocity[1] += PUSH * chance(random);
    }
  }

  /** A visitor holds a ball at a place of its platform. */
  hold(i, place) {
    this.position[i] = place.map((p) => clip(p, -HALF_SIDE, HALF_SIDE));
    this.velocity[i] = [0, 0];
  }

  /** ... and lets it go with a speed. */
  release(i, velocity) {
    this.velocity[i] = velocity.map((v) => clip(v, -THROW, THROW));
  }

  /** A click pushes the ball away from it. */
  push(i, place) {
    const away = this.position[i].map((p, k) => p - place[k]);
    const length = Math.hypot(...away) || 1;
    this.velocity[i] = this.velocity[i].map((v, k) => v + (PUSH * away[k]) / length);
  }

  snapshot() {
    return structuredClone({ tilt: this.tilt, position: this.position, age: this.age });
  }
}
