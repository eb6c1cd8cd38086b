/** The golden inputs, run on an engine of this browser and held against the numpy kernels' answers. */

import { bytes, json } from "./files.mjs";

/** Logarithm of the smallest float32 that has all its digits. */
const UNDERFLOW = Math.fround(Math.log(2 ** -126));
const ARRAYS = { float32: Float32Array, int32: Int32Array, int64: Int32Array, bool: Uint8Array };
const WARM_UP = 5;
const RUNS = 100;
const RUNS_AT_ONCE = 10;
const MOST_MILLISECONDS = 600;

/** golden.json with the numbers of golden.bin. */
export const readGolden = async () => ({ ...(await json("golden.json")), data: await bytes("golden.bin") });

/** Lets the page breathe: what is checked in idle time is not to be felt. */
const idle = () => new Promise((resolve) => (window.requestIdleCallback ?? setTimeout)(resolve, { timeout: 100 }));

/**
 * Runs all cases on one engine. Nothing is thrown: an engine that fails is an answer with `error`.
 * @returns {Promise<{backend: string, passed: boolean, error?: string, outputs?: object[], worst?: object,
 *   numbers?: number, median?: number, slow?: number, device?: string}>}
 */
export async function check(host, backend, golden) {
  try {
    const model = await host.model(backend);
    const outputs = await compared(model, golden);
    const worst = outputs.reduce((a, b) => (b.needed > a.needed ? b : a));
    const passed = outputs.every((output) => output.passed);
    const numbers = outputs.reduce((sum, output) => sum + output.numbers, 0);
    return { backend, passed, outputs, worst, numbers, ...(await timed(model, golden)), device: model.device() };
  } catch (error) {
    return { backend, passed: false, error: String(error?.message ?? error) };
  }
}

async function compared(model, golden) {
  const found = new Map();
  let last = {};
  for (const spec of golden.cases) {
    await idle();
    const fed = spec.inputs.map((input) => {
      const fromLast = spec.continues ? last[memoryOf(golden, input.name)]?.data : undefined;
      return { ...input, data: fromLast ?? tensorOf(golden.data, input) };
    });
    last = await run(model, fed, spec.outputs.map(({ name }) => name));
    for (const output of spec.outputs) {
      const answer = last[output.name].data;
      const difference = differing(output, tensorOf(golden.data, output), answer, golden.tolerance[output.name]);
      const old = found.get(output.name) ?? { name: output.name, passed: true, worst: 0, needed: -1, numbers: 0 };
      const worse = difference.needed > old.needed;
      found.set(output.name, {
        ...old,
        ...(worse && { needed: difference.needed, case: spec.name }),
        worst: Math.max(old.worst, difference.worst),
        passed: old.passed && difference.passed,
        numbers: old.numbers + difference.numbers,
      });
    }
  }
  return [...found.values()];
}

const memoryOf = (golden, input) => (golden.memory?.input === input ? golden.memory.output : undefined);

const run = (model, fed, names) => model.run(Object.fromEntries(fed.map((input) => [input.name, input])), names);

function tensorOf(buffer, { dtype, shape, offset }) {
  return new ARRAYS[dtype](buffer, offset, shape.reduce((a, b) => a * b, 1));
}

/** By |a − b| ≤ atol + rtol·|b|; integers must be equal, but where the reference's best scores tie. */
function differing({ dtype, floored, ties = [] }, expected, answer, { atol, rtol }) {
  if (answer.length !== expected.length) {
    return { passed: false, worst: Infinity, needed: Infinity, numbers: expected.length };
  }
  const got = floored === undefined ? answer : settled(answer, floored);
  const free = new Set(ties);
  const found = { passed: true, worst: 0, needed: 0, numbers: expected.length };
  expected.forEach((b, i) => {
    const a = got[i];
    if (a === b || free.has(i) || (Number.isNaN(a) && Number.isNaN(b))) return;
    const difference = Number.isFinite(a) && Number.isFinite(b) ? Math.abs(a - b) : Infinity;
    if (!(difference <= (dtype === "float32" ? atol + rtol * Math.abs(b) : 0))) found.passed = false;
    found.worst = Math.max(found.worst, difference);
    // How much of what is allowed it takes: 1 is the bound.
    found.needed = Math.max(found.needed, difference / (dtype === "float32" ? atol + rtol * Math.abs(b) : 0.5));
  });
  return found;
}

/** Log-probabilities that say "never", all at one value; exporter/verify/difference.py says why. */
function settled(values, branches) {
  const own = Float32Array.from(values);
  const width = branches.reduce((a, b) => a + b, 0);
  for (let row = 0; row < own.length; row += width) {
    let start = row;
    for (const count of branches) {
      const part = own.subarray(start, (start += count));
      const floor = Math.fround(Math.max(...part) + UNDERFLOW + Math.log(count));
      part.forEach((value, i) => (part[i] = Math.max(value, floor)));
    }
  }
  return own;
}

/** Median and 95th percentile of one decision for one agent, in ms: inputs given, model run, answers read back. */
async function timed(model, golden) {
  const spec = golden.cases.find(({ rows }) => rows === 1) ?? golden.cases[0];
  const fed = spec.inputs.map((input) => ({ ...input, data: tensorOf(golden.data, input) }));
  const names = spec.outputs.map(({ name }) => name);
  for (let i = 0; i < WARM_UP; i++) await run(model, fed, names);
  const times = [];
  let spent = 0;
  while (times.length < RUNS && spent < MOST_MILLISECONDS) {
    await idle();
    for (let n = 0; n < RUNS_AT_ONCE; n++) {
      const before = performance.now();
      await run(model, fed, names);
      times.push(performance.now() - before);
      spent += times.at(-1);
    }
  }
  times.sort((a, b) => a - b);
  const at = (share) => times[Math.min(times.length - 1, Math.floor(share * times.length))];
  return { median: at(0.5), slow: at(0.95), runs: times.length };
}

/** The browser and the machine, in words. */
export function visitor() {
  const agent = navigator.userAgent;
  const [, name, version] =
    /(Edg|OPR|Firefox|SamsungBrowser)\/(\d+)/.exec(agent) ?? /(Chrome)\/(\d+)/.exec(agent) ?? /(Version)\/(\d+).*Safari/.exec(agent) ?? [];
  const names = { Edg: "Edge", OPR: "Opera", SamsungBrowser: "Samsung Internet", Version: "Safari" };
  const system =
    ["Android", "iPhone", "iPad", "Windows", "Mac OS X", "CrOS", "Linux"].find((word) => agent.includes(word)) ?? "";
  const shown = { "Mac OS X": "macOS", CrOS: "ChromeOS" }[system] ?? system;
  const cores = navigator.hardwareConcurrency;
  const browser = name === undefined ? "this browser" : `${names[name] ?? name} ${version}`;
  return `${browser}${shown && ` on ${shown}`}${cores ? `, ${cores} processor cores` : ""}`;
}
