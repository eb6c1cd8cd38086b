/** The policies of this page, on whichever engine is asked for. */

import { withModule, withOnnx, withTfjs } from "./engines.mjs";
import { artifacts, bytes, json } from "./files.mjs";
import { makers } from "./makers.mjs";
import { Policy } from "./policy.mjs";

export class Host {
  #engines;
  #sources = {};
  /** What is loaded, by engine and model: promises. */
  #models = new Map();
  #policies = {};

  /** @param {{name: string, script: string | null}[]} backends "js", "onnxruntime-web", or a backend of TensorFlow.js */
  constructor(backends) {
    this.#engines = Object.fromEntries(backends.map(({ name, script }) => {
      return [name, name === "js" ? withModule : name === "onnxruntime-web" ? withOnnx(script) : withTfjs(name, script)];
    }));
    this.backend = null;
  }

  /** @param {Record<string, {folder, contract, weights, onnx?}>} places of files, by the names that `policy` takes */
  async fetch(places) {
    for (const [name, { folder, contract, weights, onnx }] of Object.entries(places)) {
      this.#sources[name] = {
        contract: await json(contract),
        make: makers[name],
        weights: () => bytes(weights),
        artifacts: () => artifacts(folder),
        ...(onnx && { onnx: () => bytes(onnx) }),
      };
    }
  }

  source(name = "model") {
    return this.#sources[name];
  }

  /** A model on an engine, loaded once. An Error says why the engine is not to be had. */
  model(backend, name = "model") {
    const key = `${backend} ${name}`;
    if (!this.#models.has(key)) this.#models.set(key, this.#engines[backend](this.#sources[name]));
    return this.#models.get(key);
  }

  /** A policy on an engine. */
  async policyOn(backend, name = "model") {
    const { run } = await this.model(backend, name);
    return new Policy(this.#sources[name].contract, run, () => {}, 0);
  }

  /** Let all policies of the page run on an engine. */
  async start(backend) {
    const fresh = {};
    for (const name of Object.keys(this.#sources)) fresh[name] = await this.policyOn(backend, name);
    this.#policies = fresh;
    this.backend = backend;
  }

  policy(name = "model") {
    return this.#policies[name];
  }

  /** A decision of the policy called `name`, as policy.decide has it. */
  decide(name, observations, options) {
    return this.#policies[name].decide(observations, options);
  }
}
