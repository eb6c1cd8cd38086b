/**
 * The page's side of browser.mjs: starts the runtime that the address names, then answers requests for ever.
 *
 * Requests are calls of that runtime (serve.mjs says what a runtime is): {"call", "id", …}, first {"call": "start"}.
 * An answer is what the call gave, or {"error": message, "trapped": whether WebAssembly itself trapped}.
 */

import { pack, unpack } from "./envelope.mjs";
import { OnnxModels } from "./onnxruntime.mjs";
import { GraphModels } from "./tfjs.mjs";

const MODULES = new URL("../modules/", import.meta.url).href;
const TFJS = `${MODULES}@tensorflow/tfjs/dist/tf.min.js`;
const TFJS_WASM = `${MODULES}@tensorflow/tfjs-backend-wasm/dist/`;
const ORT = `${MODULES}onnxruntime-web/dist/`;

/** The whole package, as a user's page loads it, and one backend of it. */
async function startTfjs(backend) {
  await script(TFJS);
  const { tf } = globalThis;
  if (backend === "wasm") {
    await script(`${TFJS_WASM}tf-backend-wasm.min.js`);
    tf.wasm.setWasmPaths(TFJS_WASM);
  }
  const models = new GraphModels(tf, tf.loadGraphModel, async (artifacts) => artifacts); // they come with the request
  await models.useBackend(backend);
  return [models, backend === "webgl" ? renderer(tf) : null];
}

/** What draws. Textures of 16-bit floats (phones) are refused: their answers differ in the third digit. */
function renderer(tf) {
  if (!tf.env().getBool("WEBGL_RENDER_FLOAT32_ENABLED")) throw new Error("WebGL has no 32-bit float textures here");
  const { gl } = tf.backend().getGPGPUContext();
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  return gl.getParameter(info === null ? gl.RENDERER : info.UNMASKED_RENDERER_WEBGL);
}

async function startOnnx() {
  const ort = await import(`${ORT}ort.wasm.min.mjs`);
  ort.env.wasm.wasmPaths = ORT;
  const models = new OnnxModels(ort, async (bytes) => bytes); // they come with the request
  await models.warmUp();
  return [models, null];
}

const RUNTIMES = {
  "tfjs-cpu@chromium": () => startTfjs("cpu"),
  "tfjs-wasm@chromium": () => startTfjs("wasm"),
  "tfjs-webgl": () => startTfjs("webgl"),
  "onnxruntime-web@chromium": startOnnx,
  "litert-web": async () => [await (await import("../litert/web.mjs")).start(MODULES), null],
};

function script(src) {
  return new Promise((resolve, reject) => {
    const element = Object.assign(document.createElement("script"), { src });
    element.onload = () => resolve();
    element.onerror = () => reject(new Error(`${src.slice(MODULES.length)} is not among the npm packages`));
    document.head.append(element);
  });
}

// ---- requests -------------------------------------------------------------------------------------------------------

const models = new Map();
let runtime;

/** Each gives the answer's fields and, where it has some, the tensors' bytes. */
const CALLS = {
  async start() {
    let device;
    [runtime, device] = await RUNTIMES[new URLSearchParams(location.search).get("runtime")]();
    return [{ version: runtime.version, device }];
  },
  async load({ id, artifacts, signature }, [bytes]) {
    const own = bytes.slice(); // a buffer that holds nothing else: tfjs reads it from its start
    const content = artifacts === undefined ? own : { ...artifacts, weightData: own.buffer };
    const model = await runtime.load({ path: content, signature });
    models.set(id, model);
    return [{ inputs: model.inputs, outputs: model.outputs }];
  },
  async run({ id, header }, bodies) {
    const [tensors, bytes] = await runtime.run(models.get(id), header, bodies);
    return [{ tensors }, bytes];
  },
  async unload({ id }) {
    await runtime.unload(models.get(id));
    models.delete(id);
    return [{}];
  },
  memory: async () => [{ counts: await runtime.memory() }],
};

async function answer({ fields, bodies }) {
  try {
    const [results, bytes = []] = await CALLS[fields.call](fields, bodies);
    return pack(results, bytes);
  } catch (error) {
    const trapped = error instanceof WebAssembly.RuntimeError;
    return pack({ error: String(error?.message ?? error), trapped }, []);
  }
}

/** @param {BlobPart[] | null} last the last answer; the first exchange has none */
async function exchange(last) {
  const response = await fetch("exchange", { method: "POST", body: last && new Blob(last) });
  return unpack(new Uint8Array(await response.arrayBuffer()));
}

for (let last = null; ; ) last = await answer(await exchange(last));
