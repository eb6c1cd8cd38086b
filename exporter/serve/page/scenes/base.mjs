/**
 * What the environments have in common; exporter/play/environments/base.py in JavaScript, the same lives for the same seed.
 *
 * Numbers are doubles, as in numpy; what an agent sees is rounded to float32 last. `step` resets the agents whose
 * episode ended, so the observation it gives is already the first of their next one.
 */

/** A stream of random numbers per agent, by mulberry32. */
export class Streams {
  #state;

  constructor(seed, agents) {
    this.#state = Uint32Array.from({ length: agents }, (_, i) => (Math.imul(seed >>> 0, 0x9e3779b9) + i) >>> 0);
    this.#state.forEach((_, i) => (this.#state[i] = this.uniform(i) * 4294967296));
  }

  /** A number in [low, high) for one agent. */
  uniform(agent, low = 0, high = 1) {
    const state = (this.#state[agent] + 0x6d2b79f5) >>> 0;
    this.#state[agent] = state;
    let t = Math.imul(state ^ (state >>> 15), state | 1);
    t ^= t + Math.imul(t ^ (t >>> 7), t | 61);
    return low + (high - low) * (((t ^ (t >>> 14)) >>> 0) / 4294967296);
  }
}

export class Environment {
  #streams;

  /** `lasting`: whether an episode that was cut off is one that went well. */
  constructor(agents, { maxSteps, lasting }) {
    this.agents = agents;
    this.maxSteps = maxSteps;
    this.lasting = lasting;
  }

  reset(seed = 0) {
    this.#streams = new Streams(seed, this.agents);
    this.age = new Array(this.agents).fill(0);
    this.isFirst = new Array(this.agents).fill(true);
    this.allocate();
    for (let i = 0; i < this.agents; i++) this.begin(i);
    return this.observe(this.isFirst);
  }

  /**
   * Advance by one decision. The last observation of an ended episode is not kept: nothing here learns.
   * @returns {{observation: object, rewards: any[], terminated: boolean[], truncated: boolean[], success: boolean[]}}
   */
  step(actions) {
    const [rewards, terminated, truncated, success] = [[], [], [], []];
    for (let i = 0; i < this.agents; i++) {
      const { reward, ended, won } = this.advance(i, actions);
      this.age[i] += 1;
      rewards.push(reward);
      terminated.push(ended);
      truncated.push(!ended && this.age[i] >= this.maxSteps);
      success.push((ended && won) || (truncated[i] && this.lasting));
    }
    this.isFirst = terminated.map((ended, i) => ended || truncated[i]);
    this.isFirst.forEach((over, i) => {
      if (!over) return;
      this.age[i] = 0;
      this.begin(i);
    });
    return { observation: this.observe(this.isFirst), rewards, terminated, truncated, success };
  }

  draw(agent, low, high) {
    return this.#streams.uniform(agent, low, high);
  }
}

export const clip = (value, low, high) => Math.min(Math.max(value, low), high);

/** A number in [-1, 1) of a uniform one; for what a visitor does, which is not the environment's own chance. */
export const chance = (random) => 2 * random() - 1;

export const pairs = (count) => Array.from({ length: count }, () => [0, 0]);
