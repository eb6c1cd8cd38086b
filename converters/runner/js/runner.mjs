/**
 * Runs TensorFlow.js graph models for a parent process, over frames on stdin and stdout.
 *
 *     node runner.mjs --backend cpu|wasm --modules DIR        DIR holds node_modules with the packages of package.json
 *
 * A frame, both ways: a little-endian uint32, the length of a header; the header, JSON in UTF-8; then the bytes of the
 * tensors that `header.tensors` = [{"name", "dtype", "shape"}] lists, one after the other, little-endian, in C order.
 * dtypes are numpy's names: float32, int32, int64 (8 bytes each, narrowed to int32 here), bool (1 byte each). Answers
 * hold no int64: TensorFlow.js has none.
 *
 *     {"cmd": "hello"}                             {"ok": true, "runtime": "tfjs-cpu", "version": "4.22.0"}
 *     {"cmd": "load", "id": "m1", "path": FOLDER}  {"ok": true, "inputs": [{"name", "dtype", "shape"}], "outputs": []}
 *     {"cmd": "run", "id": "m1", "tensors": [...]} {"ok": true, "tensors": [...]}, what `model.predict` answers
 *        with "fetch": [names]                     only these; a name is an output's key or any node's ("n", "n:1")
 *     {"cmd": "memory"}                            {"ok": true, "numTensors", "numDataBuffers", "numBytes"}
 *     {"cmd": "unload", "id": "m1"}                {"ok": true}
 *
 * Whatever goes wrong with a request is answered {"ok": false, "error": "message"}, and the process lives on. Where
 * WebAssembly itself trapped, the answer also holds "broken": true, and so do all that follow: start a new process. It
 * ends with status 0 at the end of stdin, 1 where the frames themselves cannot be followed any more (a last answer says
 * so), 2 on a bad command line.
 *
 * In `load`, dtypes and shapes are those that the model's signature declares (null: a free axis; null for the shape: a
 * free rank; null for the dtype: not declared).
 */

import { Console } from "node:console";
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import path from "node:path";
import process from "node:process";
import { parseArgs } from "node:util";

const BACKENDS = { cpu: "@tensorflow/tfjs-backend-cpu", wasm: "@tensorflow/tfjs-backend-wasm" };

/** Bytes of an element. More dtypes than are accepted, so that the frame of a refused tensor can be stepped over. */
const ELEMENT_BYTES = {
  bool: 1, int8: 1, uint8: 1, int16: 2, uint16: 2, float16: 2,
  int32: 4, uint32: 4, float32: 4, int64: 8, uint64: 8, float64: 8,
};

/** The names that TensorFlow's dtypes have in numpy. */
const NUMPY_NAMES = {
  DT_FLOAT: "float32", DT_DOUBLE: "float64", DT_HALF: "float16", DT_INT32: "int32", DT_INT64: "int64", DT_INT8: "int8",
  DT_UINT8: "uint8", DT_BOOL: "bool",
};

/** No header comes near this; a longer one means that the two sides are out of step. */
const MAX_HEADER_BYTES = 64 * 1024 * 1024;

/** The frames cannot be followed any more: nothing that comes after can be understood. */
class FramingError extends Error {}

// ---- frames ---------------------------------------------------------------------------------------------------------

/** Takes exact numbers of bytes from a stream. */
class ByteReader {
  #chunks;
  #rest = Buffer.alloc(0);

  constructor(stream) {
    this.#chunks = stream[Symbol.asyncIterator]();
  }

  /**
   * @param {number} count
   * @returns {Promise<Buffer | null>} null where the stream ends before the first of these bytes
   */
  async take(count) {
    const parts = [this.#rest];
    let size = this.#rest.length;
    while (size < count) {
      const { done, value } = await this.#chunks.next();
      if (done) {
        if (size === 0) return null;
        throw new FramingError(`stdin ended within a frame: ${size} of ${count} bytes`);
      }
      parts.push(value);
      size += value.length;
    }
    const all = parts.length === 1 ? parts[0] : Buffer.concat(parts, size);
    this.#rest = all.subarray(count);
    return all.subarray(0, count);
  }
}

/**
 * Reads one frame whole, also where its tensors are not acceptable: the next frame begins behind it.
 * @param {ByteReader} reader
 * @returns {Promise<{header: object, bodies: Buffer[]} | {problem: string} | null>} null at the end of stdin
 */
async function readFrame(reader) {
  const prefix = await reader.take(4);
  if (prefix === null) return null;
  const length = prefix.readUInt32LE();
  if (length > MAX_HEADER_BYTES) throw new FramingError(`a header of ${length} bytes`);
  const text = (await takeAll(reader, length)).toString("utf8");
  let header;
  try {
    header = JSON.parse(text);
  } catch (error) {
    // A header that is no JSON lists no tensors: the next frame is taken to begin right behind it.
    return { problem: `the header is not JSON: ${error.message}` };
  }
  if (header === null || typeof header !== "object" || Array.isArray(header)) {
    return { problem: "the header is not an object" };
  }
  const specs = header.tensors ?? [];
  if (!Array.isArray(specs)) throw new FramingError('"tensors" is not a list');
  const bodies = [];
  for (const spec of specs) bodies.push(await takeAll(reader, byteLength(spec)));
  return { header, bodies };
}

/** As `reader.take`, within a frame: the end of the stream is an error here. */
async function takeAll(reader, count) {
  if (count === 0) return Buffer.alloc(0);
  const bytes = await reader.take(count);
  if (bytes === null) throw new FramingError("stdin ended within a frame");
  return bytes;
}

/** How many bytes a listed tensor has in the frame. */
function byteLength(spec) {
  const { name, dtype, shape } = spec ?? {};
  const bytes = ELEMENT_BYTES[dtype];
  const valid = Array.isArray(shape) && shape.every((dim) => Number.isSafeInteger(dim) && dim >= 0);
  if (bytes === undefined || !valid) {
    throw new FramingError(`the length of tensor '${name}' is unknown: dtype ${dtype}, shape ${JSON.stringify(shape)}`);
  }
  const count = elementCount(shape) * bytes;
  if (!Number.isSafeInteger(count)) throw new FramingError(`tensor '${name}' is too large: ${JSON.stringify(shape)}`);
  return count;
}

const elementCount = (shape) => shape.reduce((product, dim) => product * dim, 1);

/**
 * @param {(bytes: Buffer, done: (error?: Error | null) => void) => unknown} write stdout's own
 * @param {object} header
 * @param {Buffer[]} bodies
 */
function writeFrame(write, header, bodies) {
  const text = Buffer.from(JSON.stringify(header), "utf8");
  const prefix = Buffer.alloc(4);
  prefix.writeUInt32LE(text.length);
  // Waiting for the write keeps one answer in memory at most, and lets the last one out before the process ends.
  return new Promise((resolve, reject) => {
    write(Buffer.concat([prefix, text, ...bodies]), (error) => (error ? reject(error) : resolve()));
  });
}

// ---- tensors --------------------------------------------------------------------------------------------------------

/**
 * The tensor that a frame carries. Call it inside `tf.tidy`.
 * @param {object} tf
 * @param {{name: string, dtype: string, shape: number[]}} spec
 * @param {Buffer} body
 */
function toTensor(tf, { name, dtype, shape }, body) {
  // A copy with a buffer of its own: typed arrays want an aligned start, and the cpu backend keeps what it is given.
  const data = body.buffer.slice(body.byteOffset, body.byteOffset + body.byteLength);
  switch (dtype) {
    case "float32":
      return tf.tensor(new Float32Array(data), shape, "float32");
    case "int32":
      return tf.tensor(new Int32Array(data), shape, "int32");
    case "int64":
      return tf.tensor(narrow(name, new BigInt64Array(data)), shape, "int32");
    case "bool":
      return tf.tensor(new Uint8Array(data), shape, "bool");
    default:
      throw new Error(`tensor '${name}' is ${dtype}; float32, int32, int64 and bool are taken`);
  }
}

/** int64 as int32; a value that does not fit is an error, never a wrong number. */
function narrow(name, values) {
  return Int32Array.from(values, (value) => {
    if (value !== BigInt.asIntN(32, value)) throw new Error(`tensor '${name}': ${value} does not fit int32`);
    return Number(value);
  });
}

/** The bytes of a result. Backends may hold int32 and bool in another kind of array, hence the conversions. */
function toBytes(tensor) {
  const values = tensor.dataSync();
  const array = {
    float32: () => (values instanceof Float32Array ? values : Float32Array.from(values)),
    int32: () => (values instanceof Int32Array ? values : Int32Array.from(values)),
    bool: () => Uint8Array.from(values, (value) => (value ? 1 : 0)),
  }[tensor.dtype]?.();
  if (array === undefined) throw new Error(`a result of dtype ${tensor.dtype} cannot be sent`);
  return Buffer.from(array.buffer, array.byteOffset, array.byteLength);
}

// ---- models ---------------------------------------------------------------------------------------------------------

/**
 * What `tf.loadGraphModel` takes, from a folder with model.json and its shards.
 * @param {string} folder
 */
async function readArtifacts(folder) {
  const json = JSON.parse(await readFile(path.join(folder, "model.json"), "utf8"));
  if (json?.modelTopology?.node === undefined) throw new Error("model.json holds no graph (modelTopology.node)");
  // Without it tfjs dies of "Cannot read properties of undefined (reading 'producer')", which tells nobody what to do.
  if (json.modelTopology.versions === undefined) throw new Error("model.json lacks modelTopology.versions");
  const manifest = json.weightsManifest ?? [];
  return {
    ...json,
    weightSpecs: manifest.flatMap((group) => group.weights),
    weightData: await readShards(folder, manifest.flatMap((group) => group.paths)),
  };
}

/**
 * The shards, joined into an ArrayBuffer that holds nothing else: tfjs reads `.buffer` of a typed array from its start,
 * and a small Buffer of Node's is a piece of a shared pool.
 */
async function readShards(folder, names) {
  const root = path.resolve(folder);
  const shards = [];
  for (const name of names) {
    const file = path.resolve(root, name);
    // model.json may come from anywhere; it must not make this process read other files.
    if (!file.startsWith(root + path.sep)) throw new Error(`the shard ${name} lies outside the model's folder`);
    shards.push(await readFile(file));
  }
  const joined = new Uint8Array(shards.reduce((sum, shard) => sum + shard.length, 0));
  let offset = 0;
  for (const shard of shards) {
    joined.set(shard, offset);
    offset += shard.length;
  }
  return joined.buffer;
}

/**
 * Loads a model; where that fails, the weights that were decoded already are freed.
 *
 * It stays the public, asynchronous `loadGraphModel`, as in a user's page. An engine's scope may lie open around an
 * await here because one request is served at a time.
 */
async function loadModel(tf, loadGraphModel, folder) {
  const artifacts = await readArtifacts(folder);
  const engine = tf.engine();
  let model;
  engine.startScope("load");
  try {
    model = await loadGraphModel({ load: async () => artifacts });
  } finally {
    engine.endScope(model?.weights);
  }
  try {
    return { model, inputs: describeInputs(model), outputs: describeOutputs(model) };
  } catch (error) {
    model.dispose();
    throw error;
  }
}

/**
 * Inputs: `model.predict` takes a map whose keys are looked up in `signature.inputs`; the entry's `name` ("node:0")
 * says which node is fed. A key that is not in the signature is taken for a node's name. Without inputs there
 * (the official converter, from a frozen graph) only the placeholders' names are left.
 */
function describeInputs(model) {
  const entries = Object.entries(model.modelSignature?.inputs ?? {}).filter(([, info]) => info.resourceId == null);
  if (entries.length > 0) return entries.map(([key, info]) => describe(key, info));
  return model.inputs.map(({ name, dtype, shape }) => {
    return { name, dtype: dtype ?? null, shape: shape?.map(freeAxis) ?? null };
  });
}

/**
 * Outputs: `predict` runs `model.outputNodes`, which are the keys of `signature.outputs` turned round (tensor name to
 * key, then node to key), and names the results by position: the i-th is `userDefinedMetadata.structuredOutputKeys[i]`.
 * Without structuredOutputKeys it answers a bare tensor or a list. So two keys for one tensor leave one output, two
 * outputs of one node both get the later key, and a node that is missing is left out in silence; in all three the names
 * would slip onto other values. Each output needs a node of its own (an Identity). The positions are those of
 * JavaScript's objects, where keys like "12" come first whatever the file says.
 *
 * `source` is the name that `model.execute` takes for the output, `name` what `predict` calls it.
 */
function describeOutputs(model) {
  const sources = model.outputNodes;
  const names = model.modelStructuredOutputKeys ?? sources;
  const counts = [names.length, new Set(names).size, new Set(sources).size];
  const slipped = names.some((name, i) => name !== sources[i] && sources.includes(name));
  if (slipped || counts.some((count) => count !== sources.length)) {
    throw new Error(
      `the outputs [${names}] do not fit what tfjs makes of the signature, [${sources}]: ` +
        "another order, two keys on one node, or a node is missing",
    );
  }
  return sources.map((source, i) => {
    const info = model.modelSignature?.outputs?.[source];
    return { source, ...(info ? describe(names[i], info) : { name: names[i], dtype: null, shape: null }) };
  });
}

/** An entry of the signature, as this protocol writes it. */
function describe(name, { dtype, tensorShape }) {
  const known = tensorShape !== undefined && !tensorShape.unknownRank;
  return {
    name,
    dtype: NUMPY_NAMES[dtype] ?? null,
    shape: known ? (tensorShape.dim ?? []).map(({ size }) => freeAxis(Number(size))) : null,
  };
}

const freeAxis = (size) => (size >= 0 ? size : null);

/**
 * One synchronous run. Everything happens inside `tidy`, which frees the inputs, the results and what lies between, and
 * leaves the weights; freeing by hand would be wrong where a result *is* a weight or an input (a graph may say so).
 * @returns {[object[], Buffer[]]} the list for the header, and the bytes
 */
function runModel(tf, { model, outputs }, { tensors = [], fetch }, bodies) {
  const list = [];
  const bytes = [];
  tf.tidy(() => {
    const feeds = {};
    tensors.forEach((spec, i) => (feeds[spec.name] = toTensor(tf, spec, bodies[i])));
    const results = fetch === undefined ? predict(model, outputs, feeds) : execute(model, outputs, feeds, fetch);
    for (const [name, tensor] of results) {
      if (tensor == null) throw new Error(`the model gave no value for '${name}'`);
      list.push({ name, dtype: tensor.dtype, shape: tensor.shape });
      bytes.push(toBytes(tensor));
    }
  });
  return [list, bytes];
}

/** @returns {[string, object][]} what `model.predict` answers, whichever of its three forms it takes */
function predict(model, outputs, feeds) {
  const answer = model.predict(feeds);
  if (model.modelStructuredOutputKeys != null) return Object.entries(answer);
  const tensors = Array.isArray(answer) ? answer : [answer];
  return tensors.map((tensor, i) => [outputs[i].name, tensor]);
}

/** Only some outputs, or inner nodes: tfjs then computes no more than these need, and asks for no other feeds. */
function execute(model, outputs, feeds, fetch) {
  if (!Array.isArray(fetch) || fetch.length === 0) throw new Error('"fetch" must be a list of names, not an empty one');
  const sources = new Map(outputs.map(({ name, source }) => [name, source]));
  const answer = model.execute(feeds, fetch.map((name) => sources.get(name) ?? name));
  const tensors = Array.isArray(answer) ? answer : [answer];
  return fetch.map((name, i) => [name, tensors[i]]);
}

// ---- the process ----------------------------------------------------------------------------------------------------

/**
 * The three packages that a graph model needs; the whole of @tensorflow/tfjs would load layers, data and webgl as well.
 * @param {string} backend "cpu" or "wasm"
 * @param {string} modules the folder that holds node_modules (this file may lie elsewhere, as in site-packages)
 */
async function startRuntime(backend, modules) {
  const require = createRequire(path.join(path.resolve(modules), "package.json"));
  const tf = require("@tensorflow/tfjs-core");
  const { loadGraphModel } = require("@tensorflow/tfjs-converter");
  const kernels = require(BACKENDS[backend]);
  if (backend === "wasm") kernels.setWasmPaths(path.dirname(require.resolve(BACKENDS.wasm)) + path.sep);
  // tfjs would fall back to another backend in silence; the answer must be this one's or none.
  const started = await tf.setBackend(backend);
  if (!started || tf.getBackend() !== backend) throw new Error(`the backend ${backend} did not start`);
  return { tf, loadGraphModel };
}

/** Serves requests until stdin ends. */
async function serve(backend, modules, write) {
  const models = new Map();
  let runtime;
  let breakdown = null;

  const loaded = (id) => {
    const entry = models.get(id);
    if (entry === undefined) throw new Error(`no model '${id}' is loaded`);
    return entry;
  };

  /** Every command gives the answer's header without "ok" and, where it has some, the tensors' bytes. */
  const commands = {
    hello: ({ tf }) => [{ runtime: `tfjs-${backend}`, version: tf.version_core }],
    async load({ tf, loadGraphModel }, { id, path: folder }) {
      if (typeof id !== "string" || typeof folder !== "string") throw new Error('load needs "id" and "path"');
      if (models.has(id)) throw new Error(`a model '${id}' is loaded already`);
      const entry = await loadModel(tf, loadGraphModel, folder);
      models.set(id, entry);
      const outputs = entry.outputs.map(({ name, dtype, shape }) => ({ name, dtype, shape }));
      return [{ inputs: entry.inputs, outputs }];
    },
    run({ tf }, header, bodies) {
      const [tensors, bytes] = runModel(tf, loaded(header.id), header, bodies);
      return [{ tensors }, bytes];
    },
    memory({ tf }) {
      const { numTensors, numDataBuffers, numBytes } = tf.memory();
      return [{ numTensors, numDataBuffers, numBytes }];
    },
    unload(_, { id }) {
      loaded(id).model.dispose();
      models.delete(id);
      return [{}];
    },
  };

  const answer = async ({ problem, header, bodies }) => {
    try {
      if (problem !== undefined) throw new Error(problem);
      if (!Object.hasOwn(commands, header.cmd)) throw new Error(`unknown command ${JSON.stringify(header.cmd)}`);
      if (breakdown !== null) throw breakdown;
      // Started by the first request and not before, so that a missing package is an answer and not a dead process.
      runtime ??= startRuntime(backend, modules);
      const [fields, bytes = []] = await commands[header.cmd](await runtime, header, bodies);
      return [{ ok: true, ...fields }, bytes];
    } catch (error) {
      if (error instanceof WebAssembly.RuntimeError) {
        // A trap. Some kernels of the wasm backend write past the end of their results (4 bytes for each bool), so its
        // memory holds anything now, the weights included: an answer that looks right could be wrong.
        const message = `the wasm backend broke down, start a new process: ${error.message}`;
        breakdown ??= new WebAssembly.RuntimeError(message);
        return [{ ok: false, error: breakdown.message, broken: true }, []];
      }
      // A rejection need not be an Error. What follows "Require stack" in a message is a list of files, for nobody.
      return [{ ok: false, error: String(error?.message ?? error).split("\nRequire stack:")[0] }, []];
    }
  };

  const reader = new ByteReader(process.stdin);
  try {
    for (let frame = await readFrame(reader); frame !== null; frame = await readFrame(reader)) {
      await writeFrame(write, ...(await answer(frame)));
    }
  } catch (error) {
    // The parent waits for an answer: it learns why this is the last one.
    if (error instanceof FramingError) await writeFrame(write, { ok: false, error: `lost: ${error.message}` }, []);
    throw error;
  }
}

/** Keeps stdout for frames: what any package prints goes to stderr. */
function takeStdout() {
  const write = process.stdout.write.bind(process.stdout);
  process.stdout.write = process.stderr.write.bind(process.stderr);
  globalThis.console = new Console(process.stderr, process.stderr);
  // The parent has gone: there is nobody left to tell.
  process.stdout.on("error", () => process.exit(1));
  return write;
}

function commandLine() {
  const { values } = parseArgs({ options: { backend: { type: "string" }, modules: { type: "string" } } });
  if (!Object.hasOwn(BACKENDS, values.backend ?? "")) throw new Error("--backend must be cpu or wasm");
  if (values.modules === undefined) throw new Error("--modules DIR is missing: the folder that holds node_modules");
  return values;
}

async function main() {
  const write = takeStdout();
  let options;
  try {
    options = commandLine();
  } catch (error) {
    console.error(`runner.mjs: ${error.message}`);
    return 2;
  }
  try {
    await serve(options.backend, options.modules, write);
    return 0;
  } catch (error) {
    console.error(`runner.mjs: ${error instanceof FramingError ? error.message : error.stack}`);
    return 1;
  }
}

process.exitCode = await main();
