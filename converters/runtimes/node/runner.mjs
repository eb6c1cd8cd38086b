/**
 * ES modules that were written without a runtime, in Node: fed row by row, over frames on stdin and stdout.
 */

import { readFile } from "node:fs/promises";
import process from "node:process";
import { pathToFileURL } from "node:url";

import { withCode } from "../../formats/tfjs/js/policy.mjs";
import { takeStdout } from "../javascript/js/frames.mjs";
import { endWithParent, serve } from "../javascript/js/serve.mjs";
import { decide } from "./agents.mjs";

const ARRAYS = { float32: Float32Array, int32: Int32Array, int64: BigInt64Array, bool: Uint8Array };

/** The elements of a frame's tensor, as the module's arrays have them. */
function elements({ dtype }, body) {
  const data = body.buffer.slice(body.byteOffset, body.byteOffset + body.byteLength);
  const values = new ARRAYS[dtype](data);
  return dtype === "int64" ? Float64Array.from(values, Number) : values;
}

async function load({ path, seed }) {
  const module = await import(pathToFileURL(path).href);
  module.load?.(await readFile(path.replace(/\.mjs$/, ".weights.bin")));
  const { default: Code, ports } = module;
  const agent = new Code(seed ?? Math.floor(Math.random() * 2 ** 48));
  const wrong = agent.selftest();
  if (wrong) throw new Error(`its self test finds ${wrong} wrong numbers`);
  agent.reset(seed ?? Math.floor(Math.random() * 2 ** 48));
  const named = (some) => Object.entries(some).map(([name, [, dtype]]) => ({ name, dtype, shape: null }));
  return { Code, answer: withCode(module, agent), ports, inputs: named(ports.inputs), outputs: named(ports.outputs) };
}

/** Several arrays of a dtype as the bytes of one tensor. */
function bytesOf(dtype, arrays) {
  const values = arrays.flatMap((array) => Array.from(array));
  return new Uint8Array((dtype === "int64" ? BigInt64Array.from(values, BigInt) : ARRAYS[dtype].from(values)).buffer);
}

async function run(model, { tensors = [], fetch, drive }, bodies) {
  const { answer, ports } = model;
  if (drive !== undefined) {
    const found = decide(model, tensors.map((spec, i) => [spec.name, elements(spec, bodies[i])]), drive);
    const asked = fetch.filter((name) => found[name] !== undefined);
    const results = asked.map((name) => ({ name, dtype: found[name][0], shape: found[name][1] }));
    return [results, asked.map((name) => bytesOf(found[name][0], found[name][2]))];
  }
  const feeds = Object.fromEntries(tensors.map((spec, i) => [spec.name, { data: elements(spec, bodies[i]) }]));
  const found = await answer(feeds, fetch);
  const dtypes = Object.fromEntries(Object.entries(ports.outputs).map(([name, [, dtype]]) => [name, dtype]));
  const results = fetch.map((name) => ({ name, dtype: dtypes[name] ?? "float32", shape: found[name].shape }));
  const bytes = results.map(({ name, dtype }) => {
    const { data } = found[name];
    return new Uint8Array((dtype === "int64" ? BigInt64Array.from(data, BigInt) : data).buffer);
  });
  return [results, bytes];
}

endWithParent();
const runtime = { name: "node", version: process.version, load, run, unload() {}, memory: () => ({}) };
await serve(async () => runtime, takeStdout());
