/**
 * LiteRT models in LiteRT.js (@litertjs/core), in a page: tensors in and out, what a signature says, a run.
 *
 * It runs files for a fixed number of agents alone (`--batch`), on the processor (XNNPACK in WebAssembly).
 */

/** The dtypes that LiteRT.js has, by numpy's names → the array that holds such elements. */
const ARRAYS = { float32: Float32Array, int32: Int32Array, uint8: Uint8Array };

/** A runtime as serve.mjs wants it, started from the folder of the npm packages. */
export async function start(modules) {
  const lite = await import(`${modules}@litertjs/core/dist/index.js`);
  await lite.loadLiteRt(`${modules}@litertjs/core/wasm/`, { threads: false });
  const { version } = await (await fetch(`${modules}@litertjs/core/package.json`)).json();
  return new LitertModels(lite, version);
}

class LitertModels {
  name = "litert-web";
  #lite;

  constructor(lite, version) {
    this.#lite = lite;
    this.version = version;
  }

  async load({ path, signature }) {
    const model = await this.#lite.loadAndCompile(path, { accelerator: "wasm" });
    const runner = model.signatures[signature];
    if (runner === undefined) throw new Error(`the model has no signature ${signature}`);
    const declared = (details) => details.map(({ name, dtype, shape }) => ({ name, dtype, shape: [...shape] }));
    return { model, runner, inputs: declared(runner.getInputDetails()), outputs: declared(runner.getOutputDetails()) };
  }

  async run({ runner }, { tensors, fetch }, bodies) {
    const feeds = {};
    tensors.forEach(({ name, dtype, shape }, i) => {
      if (!Object.hasOwn(ARRAYS, dtype)) throw new Error(`tensor '${name}' is ${dtype}, which LiteRT.js does not take`);
      const { buffer, byteOffset, byteLength } = bodies[i];
      const data = new ARRAYS[dtype](buffer.slice(byteOffset, byteOffset + byteLength));
      feeds[name] = new this.#lite.Tensor(data, shape);
    });
    const results = await runner.run(feeds);
    const found = await Promise.all((fetch ?? Object.keys(results)).map((name) => read(name, results[name])));
    for (const tensor of [...Object.values(feeds), ...Object.values(results)]) tensor.delete();
    return [found.map(([spec]) => spec), found.map(([, bytes]) => bytes)];
  }

  unload({ model }) {
    model.delete();
  }

  memory() {
    throw new Error("LiteRT.js does not count its memory");
  }
}

async function read(name, tensor) {
  if (tensor === undefined) throw new Error(`the model has no output '${name}'`);
  const { dtype, layout } = tensor.type;
  const { buffer, byteOffset, byteLength } = await tensor.data();
  return [{ name, dtype, shape: [...layout.dimensions] }, new Uint8Array(buffer, byteOffset, byteLength).slice()];
}
