/** What engines are called, in the order in which people know them. */
const ENGINES = {
  js: "this page's own code",
  cpu: "TensorFlow.js (JavaScript)",
  wasm: "TensorFlow.js (WebAssembly)",
  webgl: "TensorFlow.js (WebGL)",
  webgpu: "TensorFlow.js (WebGPU)",
  "onnxruntime-web": "ONNX Runtime Web",
};
export const engine = (name) => ENGINES[name] ?? name;

/** What observations and actions are called: by policy.json's labels, else by the scene, else by number. */

export class Names {
  constructor(contract, labels, scene) {
    this.contract = contract;
    this.labels = labels ?? {};
    this.scene = scene ?? {};
  }

  /** A name for each number of an observation without images. */
  observation(spec, count) {
    const first = this.contract.inputs.find(({ role }) => role === "vector_observation");
    const scene = spec.name === first?.name ? this.scene.observations : undefined;
    return this.#named(this.labels.observations?.[spec.name] ?? scene, count, (i) => `${spec.name} ${i}`);
  }

  continuous(count) {
    return this.#named(this.labels.actions ?? this.scene.actions, count, (i) => `action ${i}`);
  }

  branch(index, count) {
    const words = this.labels.branches?.[index] ?? this.scene.branches?.[index];
    return this.#named(words, count, (i) => `action ${i}`);
  }

  #named(words, count, otherwise) {
    return Array.from({ length: count }, (_, i) => words?.[i] ?? otherwise(i));
  }
}
