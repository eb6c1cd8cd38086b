/** Crawler2D: walk to the right on four legs, in the plane. The same as exporter/play/environments/crawler2d.py. */

import { Environment, chance, clip } from "./base.mjs";

export const TIME_STEP = 0.05; // s
const SUBSTEPS = 8;
const GRAVITY = 9.81; // m/s²
const [BODY, THIGH, SHIN] = [0.9, 0.34, 0.42]; // m
const [HIP_MASS, KNEE_MASS, FOOT_MASS] = [1.25, 0.3, 0.2]; // kg
const FRICTION = 1;
const [HIP_REST, KNEE_REST] = [[0.96, 0.28], [-0.28, -0.96]]; // cosine and sine
const [HIP_REACH, KNEE_REACH] = [0.4142, 0.5774]; // tan(reach / 2)
const [STIFFNESS, DAMPING, MAX_TORQUE] = [60, 1.6, 16]; // Nm, Nm s, Nm
const FALLEN = 0.1; // m, of a hip
const [START_LIFT, START_SPEED] = [0.1, 0.5]; // m, m/s
const PACE = 0.1; // m a step
const EFFORT = 0.02;
const TOUCH = 0.005; // m, at most, between the ground and a foot on it
const PUSH = 1.5; // m/s, of a visitor
const THROW = 4; // m/s, at most
const HIGHEST = 1.4; // m, that a visitor lifts it
const CATCH_UP = 0.15; // of its way, that the camera makes in a step
const LEGS = [0, 1, 2, 3];
const POINTS = 10;
const STANDING = [[-0.45, 0.3248], [0.45, 0.3248], ...ends(0.42), ...ends(0)];

function ends(height) {
  return LEGS.map((leg) => [0.7764 * outward(leg), height]);
}

/** Outward at the rear hip is to the left. */
function outward(leg) {
  return leg % 2 === 0 ? -1 : 1;
}

/** Points: rear and front hip, then a knee per leg, then a foot. */
export const hipOf = (leg) => leg % 2;
export const kneeOf = (leg) => 2 + leg;
export const footOf = (leg) => 6 + leg;

const RODS = [
  ...[[0, 1], [2, 3]].flatMap((pair) => [
    ...pair.map((leg) => rodOf(hipOf(leg), kneeOf(leg), THIGH, HIP_MASS, KNEE_MASS)),
    ...pair.map((leg) => rodOf(kneeOf(leg), footOf(leg), SHIN, KNEE_MASS, FOOT_MASS)),
  ]),
  rodOf(0, 1, BODY, HIP_MASS, HIP_MASS),
];

function rodOf(a, b, length, massA, massB) {
  return { a, b, length, shareA: massB / (massA + massB), shareB: massA / (massA + massB) };
}

/** `x`, `y`, `vx`, `vy` have ten points per agent; `camera` follows the body, but not a visitor's hand. */
export class Crawler2D extends Environment {
  constructor(agents) {
    super(agents, { maxSteps: 400, lasting: true });
  }

  allocate() {
    const points = () => Array.from({ length: this.agents }, () => new Array(POINTS).fill(0));
    [this.x, this.y, this.vx, this.vy] = [points(), points(), points(), points()];
    this.camera = new Array(this.agents).fill(0);
    this.held = new Array(this.agents).fill(false);
  }

  begin(i) {
    const lift = this.draw(i, 0, START_LIFT);
    this.x[i] = STANDING.map(([x]) => x);
    this.y[i] = STANDING.map(([, y]) => y + lift);
    for (const velocity of [this.vx, this.vy]) velocity[i] = STANDING.map(() => this.draw(i, -START_SPEED, START_SPEED));
    this.camera[i] = 0;
  }

  advance(i, { continuous }) {
    const turns = Array.from(continuous[i], (turn) => clip(turn, -1, 1));
    const hips = LEGS.map((leg) => turned(HIP_REST, HIP_REACH * turns[leg]));
    const knees = LEGS.map((leg) => turned(KNEE_REST, KNEE_REACH * turns[4 + leg]));
    const [x, y] = [this.x[i], this.y[i]];
    const before = x[0] + x[1];
    for (let n = 0; n < SUBSTEPS; n++) this.#substep(i, hips, knees);
    const offPace = Math.abs((x[0] + x[1] - before) * 0.5 - PACE);
    const effort = turns.reduce((sum, turn) => sum + turn * turn, 0);
    if (!this.held[i]) this.camera[i] += CATCH_UP * (this.walked(i) - this.camera[i]);
    this.held[i] = false;
    return {
      reward: PACE - offPace - EFFORT * (effort * 0.125),
      ended: Math.min(y[0], y[1]) < FALLEN || x[1] <= x[0],
      won: false,
    };
  }

  #substep(i, hips, knees) {
    const [x, y, vx, vy] = [this.x[i], this.y[i], this.vx[i], this.vy[i]];
    const { body, thighs, shins } = this.#rods(i);
    const h = TIME_STEP / SUBSTEPS;
    const hip = LEGS.map((leg) => torque(thighs[leg], rotated(out(body, leg), hips[leg], leg), thighs[leg].turn - body.turn));
    const knee = LEGS.map((leg) => torque(shins[leg], rotated(thighs[leg], knees[leg], leg), shins[leg].turn - thighs[leg].turn));
    const f = LEGS.map((leg) => across(thighs[leg], (hip[leg] - knee[leg]) * (h / THIGH)));
    const g = LEGS.map((leg) => across(shins[leg], knee[leg] * (h / SHIN)));
    const b = across(body, (hip[0] + hip[1] + hip[2] + hip[3]) * (h / BODY));
    [vx, vy].forEach((v, axis) => {
      v[0] += (b[axis] - f[0][axis] - f[2][axis]) / HIP_MASS;
      v[1] -= (b[axis] + f[1][axis] + f[3][axis]) / HIP_MASS;
      for (const leg of LEGS) {
        v[kneeOf(leg)] += (f[leg][axis] - g[leg][axis]) / KNEE_MASS;
        v[footOf(leg)] += g[leg][axis] / FOOT_MASS;
      }
    });
    const [oldX, oldY] = [x.slice(), y.slice()];
    for (let k = 0; k < POINTS; k++) {
      vy[k] -= h * GRAVITY;
      x[k] += h * vx[k];
      y[k] += h * vy[k];
    }
    for (const { a, b, length, shareA, shareB } of RODS) {
      let [dx, dy] = [x[b] - x[a], y[b] - y[a]];
      const off = 1 - length / Math.sqrt(dx * dx + dy * dy);
      [dx, dy] = [dx * off, dy * off];
      x[a] += dx * shareA;
      y[a] += dy * shareA;
      x[b] -= dx * shareB;
      y[b] -= dy * shareB;
    }
    for (let k = 0; k < POINTS; k++) {
      const grip = Math.max(-y[k], 0) * FRICTION;
      x[k] -= clip(x[k] - oldX[k], -grip, grip);
      y[k] = Math.max(y[k], 0);
      [vx[k], vy[k]] = [(x[k] - oldX[k]) / h, (y[k] - oldY[k]) / h];
    }
  }

  #rods(i) {
    const [x, y, vx, vy] = [this.x[i], this.y[i], this.vx[i], this.vy[i]];
    const rod = (a, b, length) => {
      const [dx, dy] = [(x[b] - x[a]) / length, (y[b] - y[a]) / length];
      return { x: dx, y: dy, turn: (dx * (vy[b] - vy[a]) - dy * (vx[b] - vx[a])) / length };
    };
    return {
      body: rod(0, 1, BODY),
      thighs: LEGS.map((leg) => rod(hipOf(leg), kneeOf(leg), THIGH)),
      shins: LEGS.map((leg) => rod(kneeOf(leg), footOf(leg), SHIN)),
    };
  }

  observe() {
    const state = this.x.map((_, i) => {
      const { body, thighs, shins } = this.#rods(i);
      const middle = (values) => (values[i][0] + values[i][1]) * 0.5;
      const sines = [
        ...LEGS.map((leg) => sine(rotated(out(body, leg), HIP_REST, leg), thighs[leg], leg)),
        ...LEGS.map((leg) => sine(rotated(thighs[leg], KNEE_REST, leg), shins[leg], leg)),
      ];
      const turns = [
        ...LEGS.map((leg) => (thighs[leg].turn - body.turn) * outward(leg)),
        ...LEGS.map((leg) => (shins[leg].turn - thighs[leg].turn) * outward(leg)),
      ];
      const feet = LEGS.map((leg) => Number(this.y[i][footOf(leg)] <= TOUCH));
      return [middle(this.y), body.x, body.y, middle(this.vx), middle(this.vy), body.turn, ...sines, ...turns, ...feet].map(Math.fround);
    });
    return { state };
  }

  /** Metres from where it began. */
  walked(i) {
    return (this.x[i][0] + this.x[i][1]) * 0.5;
  }

  /** A visitor's push. */
  poke(random) {
    for (let i = 0; i < this.agents; i++) this.#shove(i, [PUSH * chance(random), PUSH * random()]);
  }

  /** A visitor holds the body at a place, [x, y] in m. */
  hold(i, [x, y]) {
    const by = [x - this.walked(i), clip(y, 2 * FALLEN, HIGHEST) - (this.y[i][0] + this.y[i][1]) * 0.5];
    this.x[i] = this.x[i].map((value) => value + by[0]);
    this.y[i] = this.y[i].map((value) => Math.max(value + by[1], 0));
    [this.vx[i], this.vy[i]] = [this.vx[i].map(() => 0), this.vy[i].map(() => 0)];
    this.held[i] = true;
  }

  /** ... and lets it go with a speed. */
  release(i, velocity) {
    this.#shove(i, velocity.map((v) => clip(v, -THROW, THROW)));
  }

  /** A click pushes it away. */
  push(i, place) {
    const away = [this.walked(i) - place[0], (this.y[i][0] + this.y[i][1]) * 0.5 - place[1]];
    const length = Math.hypot(...away) || 1;
    this.#shove(i, away.map((a) => (PUSH * a) / length));
  }

  #shove(i, [x, y]) {
    this.vx[i] = this.vx[i].map((v) => v + x);
    this.vy[i] = this.vy[i].map((v) => v + y);
  }

  snapshot() {
    return structuredClone({ x: this.x, y: this.y, camera: this.camera, age: this.age });
  }
}

/** (cosine, sine) of an angle further from rest by 2 arctan u. */
function turned([c, s], u) {
  const square = u * u;
  const [cosine, sine] = [(1 - square) / (1 + square), (u + u) / (1 + square)];
  return [c * cosine - s * sine, c * sine + s * cosine];
}

const out = (body, leg) => ({ x: body.x * outward(leg), y: body.y * outward(leg) });

/** A direction turned upward, on the side where the leg is. */
function rotated({ x, y }, [cosine, turn], leg) {
  const sine = turn * outward(leg);
  return { x: cosine * x - sine * y, y: cosine * y + sine * x };
}

const sine = (rest, rod, leg) => (rest.x * rod.y - rest.y * rod.x) * outward(leg);

/** A push across a rod. */
const across = ({ x, y }, strength) => [-y * strength, x * strength];

/** What takes a rod to the direction it should have, against how fast it turns to what it hangs from. */
function torque(rod, wanted, turn) {
  let error = rod.x * wanted.y - rod.y * wanted.x;
  if (rod.x * wanted.x + rod.y * wanted.y < 0) error = error < 0 ? -1 : 1;
  return clip(STIFFNESS * error - DAMPING * turn, -MAX_TORQUE, MAX_TORQUE);
}
