/**
 * What runs a model in a page: the policy's own module, TensorFlow.js on one of its backends, onnxruntime-web.
 *
 * An engine is a function of a source to a loaded model. A source has functions: `make` (the module, as engine.py wraps
 * it), `weights` (the module's), `artifacts` (a graph model), `onnx` (the bytes of an ONNX model); those that are not
 * there are undefined.
 *
 *     run(feeds, names)   → by name { data, shape }; `feeds` are { data, shape, dtype } by name
 *     device()            → what computes, in words
 *     dispose()
 */

import { script } from "./files.mjs";
import { withCode } from "./policy.mjs";

const narrow = (dtype) => (dtype === "int64" ? "int32" : dtype);
/** A stream of draws for each model that draws by itself. */
const anySeed = () => Math.floor(Math.random() * 2 ** 48);

// ---- the policy's own module ----------------------------------------------------------------------------------------

/** What runs a module that `--to js` wrote; `redraw` changes its weights before. */
export async function withModule({ make, weights }, redraw = () => {}) {
  const { Agent, ports, load, matrices } = make();
  load?.(await weights());
  redraw(matrices);
  const run = withCode({ default: Agent, ports }, new Agent(anySeed()));
  return { run, device: () => "processor, without WebAssembly", dispose() {} };
}

// ---- TensorFlow.js --------------------------------------------------------------------------------------------------

const TFJS = "vendor/tf.es2017.min.js";
const loaded = new Map();
/** The backend is one for the whole page: whatever uses it waits for its turn. */
let queue = Promise.resolve();

/** Loads a script once. */
function once(src) {
  if (!loaded.has(src)) loaded.set(src, script(src));
  return loaded.get(src);
}

function exclusive(job) {
  const done = queue.then(job);
  queue = done.catch(() => {});
  return done;
}

/** TensorFlow.js would fall back to another backend in silence; here that is an Error. */
async function switched(tf, backend) {
  if (tf.getBackend() === backend) return;
  const started = await tf.setBackend(backend);
  if (!started || tf.getBackend() !== backend) throw new Error(`the browser does not start ${backend}`);
  await tf.ready();
}

export const withTfjs = (backend, src) => ({ artifacts }) => exclusive(async () => {
  const reason = await unavailable(backend);
  if (reason !== null) throw new Error(reason);
  await once(TFJS);
  const { tf } = globalThis;
  if (src !== null) {
    await once(src);
    if (backend === "wasm") tf.wasm.setWasmPaths(new URL("vendor/", document.baseURI).href);
  }
  await switched(tf, backend);
  const model = await tf.loadGraphModel({ load: artifacts });
  const run = (feeds, names) => exclusive(async () => {
    await switched(tf, backend);
    const given = Object.fromEntries(
      Object.entries(feeds).map(([name, { data, shape, dtype }]) => [name, tf.tensor(data, shape, narrow(dtype))]),
    );
    const answer = tf.tidy(() => model.predict(given));
    const tensors = answer instanceof tf.Tensor ? { [names[0]]: answer } : answer;
    try {
      const pairs = names.map(async (name) => [name, { data: await tensors[name].data(), shape: tensors[name].shape }]);
      return Object.fromEntries(await Promise.all(pairs));
    } finally {
      tf.dispose([...Object.values(given), ...Object.values(tensors)]);
    }
  });
  return { run, device: () => device(tf, backend), dispose: () => model.dispose() };
});

/** Why a backend cannot be had, where that is known before trying (trying writes errors to the console). */
async function unavailable(backend) {
  if (backend === "webgpu") {
    if (navigator.gpu === undefined) return "this browser has no WebGPU";
    return (await navigator.gpu.requestAdapter()) === null ? "WebGPU is not available here" : null;
  }
  if (backend !== "webgl") return null;
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("webgl2") ?? canvas.getContext("webgl");
  if (context === null) return "this browser has no WebGL";
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return null;
}

/** What computes, where the browser says. */
function device(tf, backend) {
  if (backend === "wasm") return tf.env().getBool("WASM_HAS_SIMD_SUPPORT") ? "processor, with SIMD" : "processor, without SIMD";
  if (backend === "cpu") return "processor";
  if (backend !== "webgl") return "graphics";
  const { gl } = tf.findBackend("webgl").getGPGPUContext();
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl.getParameter(info === null ? gl.RENDERER : info.UNMASKED_RENDERER_WEBGL);
  const half = tf.env().getBool("WEBGL_RENDER_FLOAT32_ENABLED") ? "" : ", 16-bit floats";
  return `${/SwiftShader/.test(name) ? "SwiftShader (no graphics card)" : name}${half}`;
}

// ---- onnxruntime-web ------------------------------------------------------------------------------------------------

export const withOnnx = (module) => async ({ onnx }) => {
  if (onnx === undefined) throw new Error("this policy has no ONNX model here");
  const ort = await import(new URL(module, document.baseURI).href);
  ort.env.wasm.wasmPaths = new URL("vendor/", document.baseURI).href;
  ort.env.wasm.numThreads = 1;
  const session = await ort.InferenceSession.create(new Uint8Array(await onnx()));
  const plain = (data) => (data instanceof BigInt64Array ? Int32Array.from(data, Number) : data);
  const run = async (feeds, names) => {
    const given = {};
    for (const [name, { data, shape, dtype }] of Object.entries(feeds)) {
      if (!session.inputNames.includes(name)) continue;
      given[name] = new ort.Tensor(dtype, dtype === "int64" ? BigInt64Array.from(data, BigInt) : data, shape);
    }
    const answers = await session.run(given, names);
    return Object.fromEntries(names.map((name) => [name, { data: plain(answers[name].data), shape: answers[name].dims }]));
  };
  return { run, device: () => "processor, with SIMD", dispose: () => session.release() };
};
