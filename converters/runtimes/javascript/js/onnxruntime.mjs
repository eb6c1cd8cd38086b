/**
 * ONNX models in onnxruntime-web, in Node and in a page alike: tensors in and out, what a model declares, a run.
 *
 * It takes every dtype of the frames and gives what the model computes: int64 stays int64. `fetch` takes the names of
 * the model's outputs; inner values cannot be asked for.
 */

/** numpy's name (onnxruntime-web has the same) → the array that holds such elements. */
const ARRAYS = {
  float32: Float32Array, float64: Float64Array,
  float16: Uint16Array, // as bits: not every engine has a Float16Array
  int8: Int8Array, int16: Int16Array, int32: Int32Array, int64: BigInt64Array,
  uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, uint64: BigUint64Array,
  bool: Uint8Array,
};

/**
 * y = Identity(x) on float32[1], opset 15. To run it is to compile the WebAssembly, a second's work that the parent can
 * let go on beside other things, and to know that it works.
 */
const IDENTITY = Uint8Array.from([
  0x08, 8, // ir_version
  0x3a, 47, // graph
  0x0a, 16, 0x0a, 1, 0x78, 0x12, 1, 0x79, 0x22, 8, ...new TextEncoder().encode("Identity"), // node: x, y, op_type
  0x12, 1, 0x67, // name: g
  0x5a, 11, 0x0a, 1, 0x78, 0x12, 6, 0x0a, 4, 0x08, 1, 0x12, 0, // input x: float
  0x62, 11, 0x0a, 1, 0x79, 0x12, 6, 0x0a, 4, 0x08, 1, 0x12, 0, // output y: float
  0x42, 2, 0x10, 15, // opset_import
]);

/** A runtime as serve.mjs wants it. */
export class OnnxModels {
  #ort;
  #readModel;

  /**
   * @param {object} ort onnxruntime-web
   * @param {(path: string) => Promise<Uint8Array>} readModel
   */
  constructor(ort, readModel) {
    this.#ort = ort;
    this.#readModel = readModel;
    // One thread, so that sums are added up in one order, and no worker keeps the process alive.
    ort.env.wasm.numThreads = 1;
    ort.env.logLevel = "error";
  }

  name = "onnxruntime-web";

  get version() {
    return this.#ort.env.versions.web;
  }

  /** Throws where WebAssembly does not start. */
  async warmUp() {
    const session = await this.#session(IDENTITY);
    await session.release();
  }

  #session(bytes) {
    // 3: errors. Its warnings are about what it removes from a graph.
    return this.#ort.InferenceSession.create(bytes, { executionProviders: ["wasm"], logSeverityLevel: 3 });
  }

  async load({ path }) {
    const session = await this.#session(await this.#readModel(path));
    return { session, inputs: session.inputMetadata.map(declare), outputs: session.outputMetadata.map(declare) };
  }

  async run({ session }, { tensors = [], fetch }, bodies) {
    if (fetch !== undefined && (!Array.isArray(fetch) || fetch.length === 0)) {
      throw new Error('"fetch" must be a list of names, not an empty one');
    }
    const feeds = {};
    const answers = {};
    try {
      tensors.forEach((spec, i) => (feeds[spec.name] = this.#toTensor(spec, bodies[i])));
      const names = fetch ?? session.outputNames;
      Object.assign(answers, await session.run(feeds, names));
      const list = names.map((name) => ({ name, dtype: answers[name].type, shape: answers[name].dims }));
      return [list, names.map((name) => toBytes(name, answers[name]))];
    } finally {
      for (const tensor of [...Object.values(feeds), ...Object.values(answers)]) tensor.dispose();
    }
  }

  async unload({ session }) {
    await session.release();
  }

  memory() {
    throw new Error("onnxruntime-web does not count its memory");
  }

  #toTensor({ name, dtype, shape }, body) {
    // A copy with a buffer of its own: typed arrays want an aligned start.
    const data = body.buffer.slice(body.byteOffset, body.byteOffset + body.byteLength);
    if (!Object.hasOwn(ARRAYS, dtype)) throw new Error(`tensor '${name}' is ${dtype}, which is not taken`);
    return new this.#ort.Tensor(dtype, new ARRAYS[dtype](data), shape);
  }
}

/** The bytes of a result, copied: disposing the tensor may free what it holds. */
function toBytes(name, { type, data }) {
  if (!Object.hasOwn(ARRAYS, type)) throw new Error(`the output '${name}' is of type ${type}, which cannot be sent`);
  return Uint8Array.from(new Uint8Array(data.buffer, data.byteOffset, data.byteLength));
}

/** An input or output as the protocol writes it: an axis with a name is free. */
function declare({ name, isTensor, type, shape }) {
  if (!isTensor) return { name, dtype: null, shape: null };
  return { name, dtype: type, shape: shape.map((size) => (typeof size === "number" && size >= 0 ? size : null)) };
}
