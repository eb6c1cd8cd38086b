/**
 * Acts with a policy that export-model exported, in TensorFlow.js, onnxruntime-web or its own source code.
 *
 *     import * as tf from "@tensorflow/tfjs";
 *     import { loadPolicy } from "./policy.mjs";
 *
 *     const policy = await loadPolicy("tfjs/model.json", { tf });
 *     const { continuous } = await policy.decide({ state: [0, 0.1, 0, 4, 0, 0, 0, 0] }, { deterministic: true });
 *
 *     const other = await loadPolicy("3DBall.onnx", { ort, contract: "policy.json" });     // onnxruntime-web
 *     const alone = await loadPolicy("policy.json", { code: await import("./3DBall.mjs") });      // --to js
 *
 * It imports nothing: the runtime is the page's own. Draws are made here, from log-probabilities and with normal noise,
 * by the generator that `export_model.load` has in Python: one seed, the same actions everywhere. Types are in
 * policy.d.mts.
 */

/** The largest seed that a number holds exactly. */
const MAX_SEED = Number.MAX_SAFE_INTEGER;

const NOTHING_LEFT = "a branch whose actions are all forbidden by its masks, or an observation that is NaN";

/** What `decide` may be given besides observations, by the role of the input that takes it. */
const TAKEN = { masks: "masks", memory_in: "memory", prev_action: "previous" };

const OBSERVATIONS = new Set(["vector_observation", "visual_observation", "variable_length_observation"]);

/** Philox-2x32 with ten rounds (Salmon et al., SC11); the same draws as exporter/acting/generator.py makes. */
export class Generator {
  #key;
  #upper;
  #drawn = 0;

  constructor(seed) {
    if (!Number.isSafeInteger(seed) || seed < 0) {
      throw new RangeError(`the seed is ${seed}; give a whole number from 0 to ${MAX_SEED}`);
    }
    this.#key = seed >>> 0;
    this.#upper = Math.floor(seed / 2 ** 32);
  }

  /** In [0, 1), with all 53 bits. */
  uniform() {
    const number = this.#drawn++;
    const [high, low] = philox(number >>> 0, ((Math.floor(number / 2 ** 32) << 21) | this.#upper) >>> 0, this.#key);
    return ((high >>> 5) * 67108864 + (low >>> 6)) / 9007199254740992;
  }

  /** N(0, 1), by Box and Muller. */
  normal() {
    const radius = Math.sqrt(-2 * Math.log(1 - this.uniform()));
    return radius * Math.cos(2 * Math.PI * this.uniform());
  }

  /** An index of `logProbs` by its probability. */
  choice(logProbs) {
    const best = Math.max(...logProbs);
    if (!(best > -Infinity)) throw new Error(`nothing can be drawn from the log-probabilities ${logProbs}: ${NOTHING_LEFT}`);
    const weights = Array.from(logProbs, (v) => Math.exp(v - best));
    let left = this.uniform() * weights.reduce((sum, w) => sum + w, 0);
    for (const [index, weight] of weights.entries()) {
      left -= weight;
      if (left < 0) return index;
    }
    return weights.findLastIndex((w) => w > 0);
  }
}

/** Two words of 32 bits for a counter of two. */
function philox(first, second, key) {
  for (let turn = 0; turn < 10; turn++) {
    const word = (key + Math.imul(turn, 0x9e3779b9)) >>> 0;
    [first, second] = [(upperHalf(first, 0xd256d193) ^ word ^ second) >>> 0, Math.imul(first, 0xd256d193) >>> 0];
  }
  return [first, second];
}

/** The upper 32 bits of a product of 64, in parts that a number holds exactly. */
function upperHalf(a, b) {
  const [aHigh, aLow, bHigh, bLow] = [a >>> 16, a & 0xffff, b >>> 16, b & 0xffff];
  const middle = aHigh * bLow + Math.floor((aLow * bLow) / 65536);
  const rest = aLow * bHigh + (middle % 65536);
  return aHigh * bHigh + Math.floor(middle / 65536) + Math.floor(rest / 65536);
}

// ---- loading --------------------------------------------------------------------------------------------------------

/**
 * @param {string | object} source the URL, or in Node the path, of model.json (a loader with `load()` will do), of the
 *   .onnx (bytes will do), or for code of policy.json
 * @param {{tf?: object, ort?: object, code?: object, contract?: string | object, seed?: number}} options exactly one of
 *   tf, ort and code, the module of --to js; `contract` is policy.json, its URL or in Node its path, needed for ONNX
 *   ("policy.json" beside the model where it is left out)
 */
export async function loadPolicy(source, { tf, ort, code, contract, seed = 0 } = {}) {
  if ([tf, ort, code].filter((runtime) => runtime !== undefined).length !== 1) {
    throw new TypeError("loadPolicy needs a runtime: { tf } of TensorFlow.js, { ort } of onnxruntime-web, or { code }");
  }
  if (code !== undefined) {
    const said = contract ?? source;
    return new Policy(typeof said === "string" ? await readJson(said) : said, withCode(code), () => {}, seed);
  }
  const [run, own, dispose] = tf === undefined ? await withOnnx(ort, source, contract) : await withTfjs(tf, source);
  const found = own ?? (typeof contract === "string" ? await readJson(contract) : contract);
  if (found?.outputs === undefined) {
    throw new Error("the model holds no contract of export-model; give policy.json: loadPolicy(url, { tf, contract })");
  }
  return new Policy(found, run, dispose, seed);
}

/** Whether `source` is a path for Node to read: there is no page that it could be relative to. */
function isFile(source) {
  if (typeof source !== "string" || globalThis.location !== undefined) return false;
  return globalThis.process?.versions?.node !== undefined && !/^(https?|data|blob):/.test(source);
}

async function readFile(source) {
  const files = "node:fs/promises"; // a name that no bundler of pages follows
  const { readFile: read } = await import(/* @vite-ignore */ /* webpackIgnore: true */ files);
  return read(source.startsWith("file:") ? new URL(source) : source);
}

async function readJson(source) {
  if (isFile(source)) return JSON.parse(await readFile(source));
  const answer = await fetch(source);
  if (!answer.ok) throw new Error(`${source}: HTTP status ${answer.status}`);
  return answer.json();
}

/** The place of `name` in the folder of the file `source`. */
function beside(source, name) {
  if (isFile(source)) return source.replace(/[^/\\]*$/, name);
  return new URL(name, new URL(source, globalThis.location?.href)).href;
}

/** What tf.io.http loads of a page's server, from files. */
function fromFiles(tf, source) {
  const weights = async (manifest) => {
    const paths = manifest.flatMap((group) => group.paths);
    const parts = await Promise.all(paths.map((path) => readFile(beside(source, path))));
    return [manifest.flatMap((group) => group.weights), await new Blob(parts).arrayBuffer()];
  };
  return { load: async () => tf.io.getModelArtifactsForJSON(await readJson(source), weights) };
}

async function withTfjs(tf, source) {
  const loader = isFile(source) ? fromFiles(tf, source) : typeof source === "string" ? tf.io.http(source) : source;
  const artifacts = await loader.load();
  const model = await tf.loadGraphModel({ load: async () => artifacts });
  const held = artifacts.userDefinedMetadata?.contract;
  const run = async (feeds, names) => {
    const given = Object.fromEntries(
      Object.entries(feeds).map(([name, { data, shape, dtype }]) => {
        return [name, tf.tensor(data, shape, dtype === "int64" ? "int32" : dtype)];
      }),
    );
    const answer = tf.tidy(() => model.predict(given));
    const tensors = answer instanceof tf.Tensor ? { [names[0]]: answer } : answer;
    try {
      const pairs = names.map(async (name) => [name, { data: await tensors[name].data(), shape: tensors[name].shape }]);
      return Object.fromEntries(await Promise.all(pairs));
    } finally {
      tf.dispose([...Object.values(given), ...Object.values(tensors)]);
    }
  };
  return [run, typeof held === "string" ? JSON.parse(held) : held, () => model.dispose()];
}

async function withOnnx(ort, source, contract) {
  const session = await ort.InferenceSession.create(source);
  let own;
  if (contract === undefined && typeof source === "string") {
    own = await readJson(beside(source, "policy.json"));
  }
  const run = async (feeds, names) => {
    const given = {};
    for (const [name, { data, shape, dtype }] of Object.entries(feeds)) {
      given[name] = new ort.Tensor(dtype, dtype === "int64" ? BigInt64Array.from(data, BigInt) : data, shape);
    }
    const answers = await session.run(given, names);
    const plain = (data) => (data instanceof BigInt64Array ? Int32Array.from(data, Number) : data);
    return Object.fromEntries(names.map((name) => [name, { data: plain(answers[name].data), shape: answers[name].dims }]));
  };
  return [run, own, () => session.release()];
}

/**
 * Runs what --to js wrote, an agent after the other. An output for all agents is the last one's; those that the module
 * does not have are left out.
 */
export function withCode({ default: Code, ports }, agent = new Code()) {
  const [state, next] = ports.state ?? [];
  const answered = { ...ports.outputs };
  if (next !== undefined) answered[next] = Object.values(ports.inputs).find(([member]) => member === state);
  return async (feeds, names) => {
    const fed = Object.entries(feeds).map(([name, { data }]) => [...ports.inputs[name], data]);
    const rows = Math.max(1, ...fed.map(([, , shape, data]) => data.length / size(shape.map((n) => n ?? 1))));
    const found = {};
    for (const name of names.filter((name) => answered[name] !== undefined)) {
      const shape = answered[name][2].map((n) => n ?? rows);
      found[name] = { data: new agent[answered[name][0]].constructor(size(shape)), shape };
    }
    for (let row = 0; row < rows; row++) {
      for (const [member] of Object.values(ports.inputs)) agent[member].fill(0);
      for (const [member, , , data] of fed) {
        const { length } = agent[member];
        const start = data.length > length ? row * length : 0;
        agent[member].set(data.subarray(start, start + length));
      }
      agent.compute();
      for (const [name, { data }] of Object.entries(found)) {
        const values = agent[answered[name][0]];
        data.set(values, data.length > values.length ? row * values.length : 0);
      }
    }
    return found;
  };
}

// ---- deciding -------------------------------------------------------------------------------------------------------

/** A policy that decides; `contract` is its policy.json. */
export class Policy {
  #run;
  #dispose;
  #generator;
  #heads;
  #plain;
  #scores;
  #spread;

  constructor(contract, run, dispose, seed) {
    this.contract = contract;
    this.#run = run;
    this.#dispose = dispose;
    this.#generator = new Generator(seed);
    const count = contract.action_space === "hybrid" ? 2 : 1;
    this.#heads = contract.outputs.slice(0, count);
    const plain = contract.outputs.slice(count).filter(({ role }) => role === "deterministic");
    const companion = (head) => plain.find(({ dtype }) => (dtype === "float32") === isContinuous(head));
    this.#plain = new Map(this.#heads.map((head) => [head.name, companion(head)]).filter(([, spec]) => spec));
    this.#scores = contract.outputs.find(({ role }) => role === "log_probs");
    // A mean beside its spread is drawn from here, unless the graph has drawn already.
    const kept = contract.source?.noise_kept && Object.keys(contract.source.noise ?? {}).length > 0;
    const noisy = kept || contract.inputs.some(({ role }) => role === "noise");
    this.#spread = noisy ? undefined : contract.outputs.find(({ role }) => role === "std" || role === "log_std");
  }

  get name() {
    return this.contract.name;
  }

  /** The inputs that are observations, as the contract has them. */
  get observations() {
    return this.contract.inputs.filter(({ role }) => OBSERVATIONS.has(role));
  }

  /** Start the draws anew. */
  seed(seed) {
    this.#generator = new Generator(seed);
  }

  /** Whether an input has this role. */
  takes(role) {
    return this.contract.inputs.some((spec) => spec.role === role);
  }

  /** A group of agents whose memory and previous actions are kept for them. */
  agent(options = {}) {
    return new Agent(this, options);
  }

  /** Free what the runtime holds. */
  dispose() {
    this.#dispose();
  }

  /** See policy.d.mts. */
  async decide(observations, options = {}) {
    const { masks, memory, previous, parameters = {}, deterministic = false, seed } = options;
    if (seed !== undefined) this.seed(seed);
    const given = this.#named(observations);
    for (const name of Object.keys(parameters)) {
      if (!this.contract.inputs.some((spec) => spec.role === "parameter" && spec.name === name)) {
        throw new Error(`unknown parameter '${name}'`);
      }
    }
    const special = { masks, memory_in: memory, prev_action: previous };
    for (const [role, value] of Object.entries(special)) {
      if (value != null && !this.takes(role)) throw new Error(`the policy takes no ${TAKEN[role]}: it has no such input`);
    }
    const feeds = {};
    let rows;
    const inputs = [...this.observations, ...this.contract.inputs.filter(({ role }) => !OBSERVATIONS.has(role))];
    for (const spec of inputs) {
      if (OBSERVATIONS.has(spec.role)) {
        feeds[spec.name] = fitting(spec, this.#scaled(spec, given[spec.name]), rows);
        rows ??= feeds[spec.name].shape[0];
      } else if (spec.role === "noise") {
        const shape = spec.shape.map((n) => n ?? rows ?? 1);
        const draw = deterministic ? () => 0 : () => this.#generator.normal();
        feeds[spec.name] = { data: Float32Array.from({ length: size(shape) }, draw), shape, dtype: "float32" };
      } else if (spec.role === "parameter") {
        if (parameters[spec.name] === undefined) {
          throw new Error(`the parameter '${spec.name}' is missing: { parameters: { ${spec.name}: … } }`);
        }
        feeds[spec.name] = fitting(spec, parameters[spec.name], undefined);
      } else if (special[spec.role] == null) {
        const shape = spec.shape.map((n, i) => (i === 0 ? (rows ?? 1) : (n ?? 1)));
        const data = new (arrayOf(spec.dtype))(size(shape)).fill(spec.role === "masks" ? 1 : 0);
        feeds[spec.name] = { data, shape, dtype: spec.dtype };
      } else {
        feeds[spec.name] = fitting(spec, special[spec.role], rows);
        if (spec.role === "masks") this.#checkMasks(feeds[spec.name]);
      }
    }
    const outputs = await this.#run(feeds, this.contract.outputs.map(({ name }) => name));
    return this.#decision(outputs, deterministic);
  }

  #named(observations) {
    const names = this.observations.map(({ name }) => name);
    const isMap = observations !== null && typeof observations === "object" && !isArray(observations);
    if (!isMap) {
      if (names.length !== 1) throw new Error(`the policy has ${names.length} observations: give { ${names.join(", ")} }`);
      return { [names[0]]: observations };
    }
    for (const name of Object.keys(observations)) {
      if (!names.includes(name)) throw new Error(`unknown observation '${name}'; there are ${names}`);
    }
    for (const name of names) {
      if (observations[name] === undefined) throw new Error(`the observation '${name}' is missing; there are ${names}`);
    }
    return observations;
  }

  /** Bytes of an image as the numbers that the policy takes; what is no image or no bytes, as it is. */
  #scaled({ name, role }, value) {
    const data = value?.data ?? value;
    const range = this.contract.preprocess?.[name]?.range;
    const bytes = data instanceof Uint8Array || data instanceof Uint8ClampedArray;
    if (role !== "visual_observation" || range === undefined || !bytes) return value;
    const scaled = Float32Array.from(data, (v) => v * Math.fround((range[1] - range[0]) / 255) + range[0]);
    return value.data === undefined ? scaled : { data: scaled, shape: value.shape };
  }

  #checkMasks({ data, shape: [rows, width] }) {
    for (let agent = 0; agent < rows; agent++) {
      let start = agent * width;
      for (const [branch, count] of this.contract.branches.entries()) {
        if (!data.slice(start, (start += count)).some((allowed) => allowed > 0)) {
          throw new Error(`masks forbid every action of branch ${branch} to agent ${agent}: allow one`);
        }
      }
    }
  }

  #decision(outputs, deterministic) {
    let continuous = null;
    let discrete = null;
    const taken = {};
    for (const head of this.#heads) {
      if (isContinuous(head)) {
        const plain = deterministic ? this.#plain.get(head.name) : undefined;
        taken[head.name] = outputs[(plain ?? head).name];
        if (this.#spread && !deterministic) taken[head.name] = this.#drawn(taken[head.name], outputs[this.#spread.name]);
        continuous = rowsOf(taken[head.name]);
      } else {
        discrete = this.#discrete(head, outputs, deterministic);
        const shape = [discrete.length, discrete[0]?.length ?? 0];
        if (head.role === "sampled") taken[head.name] = { data: Int32Array.from(discrete.flat()), shape };
      }
    }
    const kept = this.contract.memory?.output;
    return { continuous, discrete, memory: kept == null ? null : outputs[kept], outputs: { ...outputs, ...taken } };
  }

  /** A draw from N(mean, σ²), as the trainer's own distribution makes it: not squashed, not clipped. */
  #drawn({ data, shape }, { data: spread }) {
    const std = this.#spread.role === "log_std" ? Math.exp : (v) => v;
    const draw = (mean, i) => mean + std(spread[i]) * Math.fround(this.#generator.normal());
    return { data: Float32Array.from(data, draw), shape };
  }

  #discrete(head, outputs, deterministic) {
    if (head.role === "deterministic") return rowsOf(outputs[head.name]);
    if (deterministic && this.#plain.has(head.name)) return rowsOf(outputs[this.#plain.get(head.name).name]);
    let scores;
    if (head.role === "probs") scores = rowsOf(outputs[head.name]).map((row) => row.map(Math.log));
    else if (this.#scores === undefined) return rowsOf(outputs[head.name]); // its sampler is all there is
    else scores = rowsOf(outputs[this.#scores.name]);
    const { branches } = this.contract;
    return scores.map((row) => {
      let start = 0;
      return (branches.length > 0 ? branches : [row.length]).map((count) => {
        const part = row.slice(start, (start += count));
        if (!deterministic) return this.#generator.choice(part);
        const most = Math.max(...part);
        if (!(most > -Infinity)) throw new Error(`nothing can be drawn from the log-probabilities ${part}: ${NOTHING_LEFT}`);
        return part.indexOf(most);
      });
    });
  }
}

/** Agents of one episode: memory and previous actions go from step to step by themselves. */
export class Agent {
  #last = null;

  constructor(policy, { deterministic = false } = {}) {
    this.policy = policy;
    this.deterministic = deterministic;
  }

  /** An episode begins: for all, or for the agents with these numbers. */
  reset(agents) {
    const last = this.#last;
    if (agents === undefined || last === null) {
      this.#last = null;
      return;
    }
    const [memory, discrete] = [last.memory, last.discrete?.map((row) => [...row]) ?? null];
    const count = (last.continuous ?? last.discrete).length;
    const data = memory && memory.data.slice();
    for (const agent of [agents].flat()) {
      if (!Number.isInteger(agent) || agent < 0 || agent >= count) {
        throw new RangeError(`unknown agent ${agent}; they are numbered 0 to ${count - 1}`);
      }
      data?.fill(0, agent * memory.shape[1], (agent + 1) * memory.shape[1]);
      discrete?.[agent].fill(0);
    }
    this.#last = { ...last, discrete, memory: memory && { data, shape: memory.shape } };
  }

  async decide(observations, { masks, parameters, deterministic = this.deterministic } = {}) {
    const last = this.#last;
    this.#last = await this.policy.decide(observations, {
      masks,
      parameters,
      memory: this.policy.takes("memory_in") ? last?.memory : undefined,
      previous: this.policy.takes("prev_action") ? last?.discrete : undefined,
      deterministic,
    });
    return this.#last;
  }
}

// ---- arrays ---------------------------------------------------------------------------------------------------------

const isContinuous = ({ role, dtype }) => role === "continuous" || (role === "deterministic" && dtype === "float32");
const size = (shape) => shape.reduce((product, n) => product * n, 1);
const isArray = (value) => Array.isArray(value) || ArrayBuffer.isView(value) || value?.data !== undefined;

function arrayOf(dtype) {
  const kinds = { float32: Float32Array, int32: Int32Array, int64: Int32Array, bool: Uint8Array };
  if (kinds[dtype] === undefined) throw new Error(`an input of dtype ${dtype} cannot be fed`);
  return kinds[dtype];
}

/** Nested arrays, a flat typed array or { data, shape } as { data, shape, dtype } for one input. */
function fitting({ name, shape: wanted, dtype }, value, rows) {
  const flat = (value?.data ?? (ArrayBuffer.isView(value) ? value : [value].flat(Infinity)));
  for (const number of ArrayBuffer.isView(flat) ? [] : flat) {
    const kind = typeof number; // a string or an object would become a number that nobody meant
    if (kind !== "number" && kind !== "boolean") throw new Error(`'${name}' holds ${kind === "object" ? "an" : "a"} ${kind}`);
  }
  if (wanted.length === 0) {
    if (flat.length !== 1) throw new Error(`'${name}' has ${flat.length} numbers; it is a single one`);
    return { data: arrayOf(dtype).from(flat), shape: [], dtype };
  }
  const inner = wanted.slice(1);
  let shape = value?.shape;
  if (shape === undefined) {
    const free = inner.filter((n) => n === null).length;
    const known = size(inner.map((n) => n ?? 1));
    if (ArrayBuffer.isView(value) || free === 0) {
      if (free > 0) throw new Error(`'${name}' has a free axis: give nested arrays or { data, shape }`);
      shape = [flat.length / known, ...inner];
      // Nested arrays say their own shape: rows of another length are no agents.
      const said = nested(value);
      if (said.length > 1 && said.length === wanted.length) shape = said;
    } else {
      shape = nested(value);
      if (shape.length === wanted.length - 1) shape = [1, ...shape];
    }
  }
  const same =
    shape.length === wanted.length && inner.every((n, i) => n === null || n === shape[i + 1]) && Number.isInteger(shape[0]);
  if (!same || size(shape) !== flat.length || (rows !== undefined && wanted[0] === null && shape[0] !== rows)) {
    const text = ["agents", ...inner.map((n) => n ?? "any")].join(", ");
    throw new Error(`'${name}' has ${flat.length} numbers; [${text}]${rows === undefined ? "" : ` for ${rows} agents`} is wanted`);
  }
  return { data: arrayOf(dtype).from(flat), shape: [...shape], dtype };
}

const nested = (value) => (Array.isArray(value) ? [value.length, ...nested(value[0])] : []);

/** A tensor's rows as arrays of numbers. */
function rowsOf({ data, shape }) {
  const width = size(shape.slice(1));
  return Array.from({ length: shape[0] }, (_, i) => Array.from(data.slice(i * width, (i + 1) * width), Number));
}
