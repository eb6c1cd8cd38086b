/**
 * Graph models of TensorFlow.js, in Node and in a page alike: tensors in and out, what a signature says, a run.
 *
 * It takes float32, int32, int64 (narrowed to int32) and bool. Answers hold no int64: TensorFlow.js has none. `fetch`
 * takes an output's key or any node's name ("n", "n:1"); without it a run is what `model.predict` answers.
 *
 * Nothing here is Node's own: bytes are Uint8Arrays, and where a model's files come from is the caller's affair.
 */

/** The names that TensorFlow's dtypes have in numpy. */
const NUMPY_NAMES = {
  DT_FLOAT: "float32", DT_DOUBLE: "float64", DT_HALF: "float16", DT_INT32: "int32", DT_INT64: "int64", DT_INT8: "int8",
  DT_UINT8: "uint8", DT_BOOL: "bool",
};

/** A runtime as serve.mjs wants it. */
export class GraphModels {
  #tf;
  #loadGraphModel;
  #readArtifacts;

  /**
   * @param {object} tf @tensorflow/tfjs-core
   * @param {Function} loadGraphModel of @tensorflow/tfjs-converter
   * @param {(path: string) => Promise<object>} readArtifacts model.json's fields with `weightSpecs` and `weightData`
   */
  constructor(tf, loadGraphModel, readArtifacts) {
    this.#tf = tf;
    this.#loadGraphModel = loadGraphModel;
    this.#readArtifacts = readArtifacts;
  }

  get name() {
    return `tfjs-${this.#tf.getBackend()}`;
  }

  get version() {
    return this.#tf.version_core;
  }

  /** tfjs would fall back to another backend in silence; the answer must be this one's or none. */
  async useBackend(backend) {
    const started = await this.#tf.setBackend(backend);
    if (!started || this.#tf.getBackend() !== backend) throw new Error(`the backend ${backend} did not start`);
  }

  async load({ path }) {
    const artifacts = await this.#readArtifacts(path);
    if (artifacts.modelTopology?.node === undefined) throw new Error("model.json holds no graph (modelTopology.node)");
    // Without it tfjs dies of "Cannot read properties of undefined (reading 'producer')", which tells nobody what to do.
    if (artifacts.modelTopology.versions === undefined) throw new Error("model.json lacks modelTopology.versions");
    return loadModel(this.#tf, this.#loadGraphModel, artifacts);
  }

  run(model, header, bodies) {
    return runModel(this.#tf, model, header, bodies);
  }

  unload({ model }) {
    model.dispose();
  }

  memory() {
    const { numTensors, numDataBuffers, numBytes } = this.#tf.memory();
    return { numTensors, numDataBuffers, numBytes };
  }
}

// ---- tensors --------------------------------------------------------------------------------------------------------

/**
 * The tensor that a frame carries. Call it inside `tf.tidy`.
 * @param {object} tf
 * @param {{name: string, dtype: string, shape: number[]}} spec
 * @param {Uint8Array} body
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
  return new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
}

// ---- models ---------------------------------------------------------------------------------------------------------

/**
 * Loads a model; where that fails, the weights that were decoded already are freed.
 *
 * It stays the public, asynchronous `loadGraphModel`, as in a user's page. An engine's scope may lie open around an
 * await here because one request is served at a time.
 */
async function loadModel(tf, loadGraphModel, artifacts) {
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
 * @returns {[object[], Uint8Array[]]} the list for the header, and the bytes
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
