/**
 * Acts with a policy that export-model exported, in TensorFlow.js or onnxruntime-web.
 *
 *     import * as tf from "@tensorflow/tfjs";
 *     import { loadPolicy } from "./policy.mjs";
 *
 *     const policy = await loadPolicy("tfjs/model.json", { tf });
 *     const { continuous } = await policy.decide({ state: [0, 0.1, 0, 4, 0, 0, 0, 0] }, { deterministic: true });
 *
 *     const other = await loadPolicy("3DBall.onnx", { ort, contract: "policy.json" });     // onnxruntime-web
 *
 * It imports nothing: the runtime is the page's own. Draws are made here, from log-probabilities and with normal noise,
 * by the generator that `exporter.load_policy` has in Python: one seed, the same actions everywhere. Types are in
 * policy.d.mts.
 */

/** The largest seed that a number holds exactly. */
const MAX_SEED = Number.MAX_SAFE_INTEGER;

const NOTHING_LEFT = "a branch whose actions are all forbidden by its masks, or an observation that is NaN";

const OBSERVATIONS = new Set(["vector_observation", "visual_observation", "variable_length_observation"]);

/** sfc32 (PractRand's Small Fast Counting generator); the same as exporter/acting/generator.py. */
export class Generator {
  #a;
  #b;
  #c;
  #counter = 1;

  constructor(seed) {
    if (!Number.isSafeInteger(seed) || seed < 0) {
      throw new RangeError(`the seed is ${seed}; give a whole number from 0 to ${MAX_SEED}`);
    }
    const low = mixed(seed >>> 0);
    const high = mixed((Math.floor(seed / 2 ** 32) ^ 0x9e3779b9) >>> 0);
    [this.#a, this.#b, this.#c] = [low, high, (low ^ high) >>> 0];
    for (let i = 0; i < 12; i++) this.#word();
  }

  #word() {
    const result = (this.#a + this.#b + this.#counter) >>> 0;
    this.#counter = (this.#counter + 1) >>> 0;
    this.#a = (this.#b ^ (this.#b >>> 9)) >>> 0;
    this.#b = (this.#c + (this.#c << 3)) >>> 0;
    this.#c = (((this.#c << 21) | (this.#c >>> 11)) + result) >>> 0;
    return result;
  }

  /** In [0, 1), with all 53 bits. */
  uniform() {
    const high = this.#word() >>> 5;
    return (high * 67108864 + (this.#word() >>> 6)) / 9007199254740992;
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
    const weights = Array.from(logProbs, (v) => (v > -Infinity ? Math.exp(v - best) : 0));
    let left = this.uniform() * weights.reduce((sum, w) => sum + w, 0);
    for (const [index, weight] of weights.entries()) {
      left -= weight;
      if (left < 0) return index;
    }
    return weights.findLastIndex((w) => w > 0);
  }
}

function mixed(word) {
  word = Math.imul(word ^ (word >>> 16), 0x21f0aaad);
  word = Math.imul(word ^ (word >>> 15), 0x735a2d97);
  return (word ^ (word >>> 15)) >>> 0;
}

// ---- loading --------------------------------------------------------------------------------------------------------

/**
 * @param {string | object} source the URL of model.json (a loader with `load()` will do) or of the .onnx (bytes will do)
 * @param {{tf?: object, ort?: object, contract?: string | object, seed?: number}} options exactly one of tf and ort;
 *   `contract` is policy.json or its URL, needed for ONNX ("policy.json" beside the model where it is left out)
 */
export async function loadPolicy(source, { tf, ort, contract, seed = 0 } = {}) {
  if ((tf === undefined) === (ort === undefined)) {
    throw new TypeError("loadPolicy needs a runtime: { tf } of TensorFlow.js, or { ort } of onnxruntime-web");
  }
  const [run, own, dispose] = tf === undefined ? await withOnnx(ort, source, contract) : await withTfjs(tf, source);
  const found = own ?? (typeof contract === "string" ? await fetched(contract) : contract);
  if (found?.outputs === undefined) {
    throw new Error("the model holds no contract of export-model; give policy.json: loadPolicy(url, { tf, contract })");
  }
  return new Policy(found, run, dispose, seed);
}

async function fetched(url) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(`${url}: HTTP status ${answer.status}`);
  return answer.json();
}

async function withTfjs(tf, source) {
  const artifacts = await (typeof source === "string" ? tf.io.http(source) : source).load();
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
    own = await fetched(new URL("policy.json", new URL(source, globalThis.location?.href)).href);
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

// ---- deciding -------------------------------------------------------------------------------------------------------

/** A policy that decides; `contract` is its policy.json. */
export class Policy {
  #run;
  #dispose;
  #generator;
  #heads;
  #plain;
  #scores;

  constructor(contract, run, dispose, seed) {
    this.contract = contract;
    this.#run = run;
    this.#dispose = dispose;
    this.#generator = new Generator(seed);
    const count = contract.action_space === "hybrid" ? 2 : 1;
    this.#heads = contract.outputs.slice(0, count);
    const plain = contract.outputs.slice(count).filter(({ role }) => role === "deterministic");
    this.#plain = new Map(plain.slice(0, count).map((spec, i) => [this.#heads[i].name, spec]));
    this.#scores = contract.outputs.find(({ role }) => role === "log_probs");
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
    const special = { masks, memory_in: memory, prev_action: previous };
    const feeds = {};
    let rows;
    const inputs = [...this.observations, ...this.contract.inputs.filter(({ role }) => !OBSERVATIONS.has(role))];
    for (const spec of inputs) {
      if (OBSERVATIONS.has(spec.role)) {
        feeds[spec.name] = fitting(spec, given[spec.name], rows);
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
    for (const name of names) {
      if (observations[name] === undefined) throw new Error(`the observation '${name}' is missing; there are ${names}`);
    }
    for (const name of Object.keys(observations)) {
      if (!names.includes(name)) throw new Error(`there is no observation '${name}'; there are ${names}`);
    }
    return observations;
  }

  #decision(outputs, deterministic) {
    let continuous = null;
    let discrete = null;
    for (const head of this.#heads) {
      if (head.role === "continuous" || (head.role === "deterministic" && head.dtype === "float32")) {
        const plain = deterministic ? this.#plain.get(head.name) : undefined;
        continuous = rowsOf(outputs[(plain ?? head).name]);
      } else {
        discrete = this.#discrete(head, outputs, deterministic);
      }
    }
    const kept = this.contract.memory?.output;
    return { continuous, discrete, memory: kept == null ? null : outputs[kept], outputs };
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
        const best = part.indexOf(Math.max(...part));
        if (best < 0) throw new Error(`the log-probabilities ${part} have no largest: ${NOTHING_LEFT}`);
        return best;
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

  /** An episode begins. */
  reset() {
    this.#last = null;
  }

  async decide(observations, { masks, parameters } = {}) {
    const last = this.#last;
    this.#last = await this.policy.decide(observations, {
      masks,
      parameters,
      memory: last?.memory,
      previous: last?.discrete,
      deterministic: this.deterministic,
    });
    return this.#last;
  }
}

// ---- arrays ---------------------------------------------------------------------------------------------------------

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
