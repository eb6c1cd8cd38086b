/**
 * Agents of a module that take turns, driven as its callers do: what converters/runtimes/agents.py asks for.
 */

/** How many there are, and what begins the names of what is fetched of each repeated decision: as in agents.py. */
const AGENTS = 3;
const EVERY = "every/";

const size = (shape) => shape.reduce((product, n) => product * (n ?? 1), 1);

/**
 * A decision of each agent; all are looked at when all have decided.
 * @param {object} model what runner.mjs loaded; its agents are kept in it
 * @param {Array<[string, object]>} fed input → a typed array of one row, or of one for each agent
 * @param {object} drive as in agents.py
 * @param {string[]} names of whose sizes the module has constants
 * @returns {Record<string, [string, number[], ArrayLike<number>[]]>} name → dtype, shape, arrays one after the other
 */
export function decide(model, fed, { seed, repeat, choose, noise, state, sized }) {
  const { Code, ports } = model;
  const first = BigInt(seed ?? 0);
  if (model.agents === undefined) model.agents = Array.from({ length: AGENTS }, (_, i) => new Code(first + BigInt(i)));
  else if (seed !== null) model.agents.forEach((agent, i) => agent.reset(first + BigInt(i)));
  const { agents } = model;
  for (const [name, data] of fed) {
    const [member] = ports.inputs[name];
    agents.forEach((agent, i) => {
      const { length } = agent[member];
      const start = data.length > length ? i * length : 0;
      agent[member].set(data.subarray(start, start + length));
    });
  }
  const [kept, next] = state ?? [];
  const shown = { ...ports.outputs };
  for (const name of noise) shown[name] = ports.inputs[name];
  if (next !== undefined) shown[next] = ports.inputs[kept];
  const before = next === undefined ? [] : agents.map((agent) => agent[shown[next][0]].slice());
  const every = Object.fromEntries(Object.keys(shown).map((name) => [name, []]));
  for (let turn = 0; turn < repeat; turn++) {
    agents.forEach((agent, i) => {
      if (next !== undefined) agent[shown[next][0]].set(before[i]);
      agent.act();
    });
    for (const [name, [member]] of Object.entries(shown)) every[name].push(...agents.map((agent) => agent[member].slice()));
  }
  const found = {};
  for (const [name, [member, dtype]] of Object.entries(shown)) {
    const { length } = agents[0][member];
    found[name] = [dtype, [AGENTS, length], every[name].slice(-AGENTS)];
    found[EVERY + name] = [dtype, [repeat, AGENTS, length], every[name]];
  }
  const { branches } = ports;
  const draws = agents.flatMap((agent) => Array.from({ length: choose }, () => agent.choose(new Int32Array(branches.length))));
  found.choose = ["int32", [AGENTS, choose, choose ? branches.length : 0], draws];
  const sizes = sized.map((name) => ports.inputs[name] ?? ports.outputs[name]);
  const constants = [...sizes.map(([, , shape]) => size(shape.slice(shape[0] === null ? 1 : 0))), ...branches];
  found.sizes = ["int32", [constants.length + 1], [Int32Array.of(...constants, branches.length)]];
  found.unusual = ["int32", [AGENTS], [Int32Array.from(agents, (agent) => agent.unusual?.() ?? 0)]];
  return found;
}
