/**
 * ES modules that were written without a runtime, in Node: fed row by row, over frames on stdin and stdout.
 */

import { readFile } from "node:fs/promises";
import process from "node:process";
import { pathToFileURL } from "node:url";

import { takeStdout } from "../javascript/js/frames.mjs";
import { endWithParent, serve } from "../javascript/js/serve.mjs";

const ARRAYS = { float32: Float32Array, int32: Int32Array, int64: BigInt64Array, bool: Uint8Array };

/** The elements of a frame's tensor, as the module's arrays have them. */
function elements({ dtype }, body) {
  const data = body.buffer.slice(body.byteOffset, body.byteOffset + body.byteLength);
  const values = new ARRAYS[dtype](data);
  return dtype === "int64" ? Float64Array.from(values, Number) : values;
}

/** How many elements one agent has. */
const count = (shape) => shape.reduce((product, n) => product * (n ?? 1), 1);

async function load({ path, seed }) {
  const { default: Policy, ports, load: takeWeights } = await import(pathToFileURL(path).href);
  takeWeights?.(await readFile(path.replace(/\.mjs$/, ".weights.bin")));
  const agent = new Policy(seed ?? Math.floor(Math.random() * 2 ** 48));
  const wrong = agent.selftest();
  if (wrong) throw new Error(`its self test finds ${wrong} wrong numbers`);
  agent.reset(seed ?? Math.floor(Math.random() * 2 ** 48));
  const named = (some) => Object.entries(some).map(([name, [, dtype]]) => ({ name, dtype, shape: null }));
  return { agent, ports, inputs: named(ports.inputs), outputs: named(ports.outputs) };
}

function run({ agent, ports }, { tensors = [], fetch, shapes }, bodies) {
  const fed = tensors.map((spec, i) => {
    const [member, , shape] = ports.inputs[spec.name];
    return { member, size: count(shape), values: elements(spec, bodies[i]) };
  });
  const rows = Math.max(1, ...fed.map(({ values, size }) => values.length / size));
  const [state, next] = ports.state ?? [];
  const answered = { ...ports.outputs };
  if (next !== undefined) answered[next] = Object.values(ports.inputs).find(([member]) => member === state);
  const answers = fetch.map((name) => {
    const [member, dtype, shape] = answered[name];
    const size = count(shape);
    return { name, member, dtype, shape, size, values: new ARRAYS[dtype](rows * size) };
  });
  for (let row = 0; row < rows; row++) {
    for (const [member] of Object.values(ports.inputs)) agent[member].fill(0);
    for (const { member, size, values } of fed) {
      const start = values.length > size ? row * size : 0;
      agent[member].set(values.subarray(start, start + size));
    }
    agent.compute();
    for (const { member, dtype, size, values } of answers) {
      values.set(dtype === "int64" ? BigInt64Array.from(agent[member], BigInt) : agent[member], row * size);
    }
  }
  const bytes = answers.map(({ values, shape, size }) => {
    const given = shape[0] === null ? values : values.slice((rows - 1) * size); // one for all agents: the last row's
    return new Uint8Array(given.buffer);
  });
  return [answers.map(({ name, dtype, shape }) => ({ name, dtype, shape: shape.map((n) => n ?? rows) })), bytes];
}

endWithParent();
const runtime = { name: "node", version: process.version, load, run, unload() {}, memory: () => ({}) };
await serve(async () => runtime, takeStdout());
