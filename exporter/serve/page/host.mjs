/** TensorFlow.js with one backend at a time, and the policies that are loaded on it. */

import { loadPolicy } from "./policy.mjs";

export class Host {
  #tf;
  #scripts;
  #loaded = new Set();
  #sources;
  #policies = {};
  #queue = Promise.resolve();

  /**
   * @param {object} tf
   * @param {{name: string, script: string | null}[]} backends
   * @param {Record<string, string>} models URLs of model.json, by the names that `decide` takes
   */
  constructor(tf, backends, models) {
    this.#tf = tf;
    this.#scripts = Object.fromEntries(backends.map(({ name, script }) => [name, script]));
    this.models = models;
    this.backend = null;
  }

  get tf() {
    return this.#tf;
  }

  /** Fetches the models, once for all backends. */
  async fetch() {
    const pairs = Object.entries(this.models).map(async ([name, url]) => {
      return [name, await this.#tf.io.http(url).load()];
    });
    this.#sources = Object.fromEntries(await Promise.all(pairs));
  }

  /** A loader as TensorFlow.js takes it. */
  loader(name) {
    return { load: async () => this.#sources[name] };
  }

  /** Runs `job` alone: the backend is one for the whole page, and a check changes it. */
  exclusive(job) {
    const done = this.#queue.then(job);
    this.#queue = done.catch(() => {});
    return done;
  }

  /** Load the policies on a backend; the old ones go. An Error says why the backend is not to be had. */
  start(backend) {
    return this.exclusive(async () => {
      await this.switchTo(backend);
      const old = Object.values(this.#policies);
      const fresh = {};
      for (const name of Object.keys(this.models)) fresh[name] = await loadPolicy(this.loader(name), { tf: this.#tf });
      old.forEach((policy) => policy.dispose());
      this.#policies = fresh;
      this.backend = backend;
    });
  }

  /** Inside `exclusive` only. TensorFlow.js would fall back to another backend in silence; here that is an Error. */
  async switchTo(backend) {
    const script = this.#scripts[backend];
    if (script != null && !this.#loaded.has(script)) {
      await added(script);
      this.#loaded.add(script);
      if (backend === "wasm") this.#tf.wasm.setWasmPaths(new URL("vendor/", document.baseURI).href);
    }
    const reason = await unavailable(backend);
    if (reason !== null) throw new Error(reason);
    const started = await this.#tf.setBackend(backend);
    if (!started || this.#tf.getBackend() !== backend) throw new Error(`the browser does not start ${backend}`);
    await this.#tf.ready();
  }

  policy(name = "model") {
    return this.#policies[name];
  }

  /** A decision of the policy called `name`, as policy.decide has it. */
  decide(name, observations, options) {
    return this.exclusive(async () => {
      if (this.#tf.getBackend() !== this.backend) await this.switchTo(this.backend); // a check was in between
      return this.#policies[name].decide(observations, options);
    });
  }
}

/** Why a backend cannot be had, where that is known before trying (trying writes errors to the console). */
async function unavailable(backend) {
  if (backend === "webgpu") {
    if (navigator.gpu === undefined) return "this browser has no WebGPU";
    return (await navigator.gpu.requestAdapter()) === null ? "this device has nothing that WebGPU runs on" : null;
  }
  if (backend !== "webgl") return null;
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("webgl2") ?? canvas.getContext("webgl");
  if (context === null) return "this browser has no WebGL";
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return null;
}

function added(src) {
  return new Promise((resolve, reject) => {
    const element = Object.assign(document.createElement("script"), { src });
    element.onload = () => resolve();
    element.onerror = () => reject(new Error(`${src} did not load`));
    document.head.append(element);
  });
}
