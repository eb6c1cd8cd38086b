/** A policy in an environment: many agents, each with a memory that starts anew with its episodes. */

export class Player {
  #memory = null;

  /** @param {() => object} policy the policy that acts now: it is another when the engine is changed */
  constructor(policy, { deterministic = true } = {}) {
    this.policy = policy;
    this.deterministic = deterministic;
  }

  /** All agents forget what they saw. */
  forget() {
    this.#memory = null;
  }

  /** @param {{state: number[][], masks?: number[][], previous?: number[][]}} observation */
  async act({ state, masks, previous }, isFirst) {
    const policy = this.policy();
    const roles = new Set(policy.contract.inputs.map(({ role }) => role));
    const decision = await policy.decide(
      { [policy.observations[0].name]: state },
      {
        masks: roles.has("masks") ? masks : undefined,
        previous: roles.has("prev_action") ? previous : undefined,
        memory: roles.has("memory_in") ? this.#remembered(isFirst) : undefined,
        deterministic: this.deterministic,
      },
    );
    this.#memory = decision.memory;
    return decision;
  }

  /** The last memory, with zeros for agents whose episode begins. */
  #remembered(isFirst) {
    if (this.#memory === null) return null;
    const { data, shape } = this.#memory;
    const own = data.slice();
    const width = own.length / shape[0];
    isFirst.forEach((first, i) => first && own.fill(0, i * width, (i + 1) * width));
    return { data: own, shape };
  }
}

/** Probabilities per branch of one row of a decision; null where the policy gives none. */
export function probabilities(contract, outputs, row = 0) {
  const spec = contract.outputs.find(({ role }) => role === "log_probs" || role === "probs");
  if (spec === undefined) return null;
  const { data, shape } = outputs[spec.name];
  const width = shape.at(-1);
  const values = Array.from(data.slice(row * width, (row + 1) * width));
  const branches = contract.branches.length > 0 ? contract.branches : [width];
  let start = 0;
  return branches.map((count) => {
    const part = values.slice(start, (start += count));
    if (spec.role === "probs") return part;
    const best = Math.max(...part);
    const weights = part.map((v) => Math.exp(v - best));
    const sum = weights.reduce((a, b) => a + b, 0);
    return weights.map((w) => w / sum);
  });
}
