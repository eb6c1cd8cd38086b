/**
 * The loop of a Node process that runs models for a parent, over frames on stdin and stdout, whatever the runtime is.
 *
 *     {"cmd": "hello"}                             {"ok": true, "runtime": "tfjs-cpu", "version": "4.22.0"}
 *     {"cmd": "load", "id": "m1", "path": PATH}    {"ok": true, "inputs": [{"name", "dtype", "shape"}], "outputs": []}
 *     {"cmd": "run", "id": "m1", "tensors": [...]} {"ok": true, "tensors": [...]}, all outputs
 *        with "fetch": [names]                     only these
 *     {"cmd": "runs", "id": "m1", "runs": [{"feeds": {input: tensor}, "fetch"}], "tensors": [...]}
 *                                                  {"ok": true, "tensors": [...]}, called "0/output", "1/output" …
 *     {"cmd": "memory"}                            {"ok": true, ...}, what the runtime counts
 *     {"cmd": "unload", "id": "m1"}                {"ok": true}
 *
 * Whatever goes wrong with a request is answered {"ok": false, "error": "message"}, and the process lives on. Where
 * WebAssembly itself trapped, the answer also holds "broken": true, and so do all that follow: start a new process.
 *
 * In `load`, dtypes and shapes are those that the model declares (null: a free axis; null for the shape: a free rank;
 * null for the dtype: not declared).
 *
 * A runtime is an object with
 *
 *     name, version
 *     load(header)                 → a model, which has `inputs` and `outputs` as above
 *     run(model, header, bodies)   → [the list for the header, the bytes of each tensor]; it may be a promise
 *     unload(model)
 *     memory()                     → an object of numbers; not all runtimes count
 */

import process from "node:process";
import { Worker } from "node:worker_threads";

import { ByteReader, FramingError, readFrame, writeFrame } from "./frames.mjs";

/** The commands, which give the answer's header without "ok" and, where it has some, the tensors' bytes. */
function commandsOn(models) {
  const loaded = (id) => {
    const model = models.get(id);
    if (model === undefined) throw new Error(`no model '${id}' is loaded`);
    return model;
  };
  return {
    hello: ({ name, version }) => [{ runtime: name, version }],
    async load(runtime, header) {
      const { id, path } = header;
      if (typeof id !== "string" || typeof path !== "string") throw new Error('load needs "id" and "path"');
      if (models.has(id)) throw new Error(`a model '${id}' is loaded already`);
      const model = await runtime.load(header);
      models.set(id, model);
      return [{ inputs: model.inputs.map(declared), outputs: model.outputs.map(declared) }];
    },
    async run(runtime, header, bodies) {
      const [tensors, bytes] = await runtime.run(loaded(header.id), header, bodies);
      return [{ tensors }, bytes];
    },
    async runs(runtime, header, bodies) {
      const model = loaded(header.id);
      const places = new Map(header.tensors.map(({ name }, i) => [name, i]));
      const list = [];
      const answers = [];
      for (const [number, { feeds, ...rest }] of header.runs.entries()) {
        const fed = Object.entries(feeds).map(([name, key]) => [name, places.get(key)]);
        const specs = fed.map(([name, i]) => ({ ...header.tensors[i], name }));
        const [tensors, bytes] = await runtime.run(model, { ...rest, tensors: specs }, fed.map(([, i]) => bodies[i]));
        list.push(...tensors.map((spec) => ({ ...spec, name: `${number}/${spec.name}` })));
        answers.push(...bytes);
      }
      return [{ tensors: list }, answers];
    },
    memory: async (runtime) => [await runtime.memory()],
    async unload(runtime, { id }) {
      await runtime.unload(loaded(id));
      models.delete(id);
      return [{}];
    },
  };
}

/** A model may keep more about an input or output than the parent is told. */
const declared = ({ name, dtype, shape }) => ({ name, dtype, shape });

/**
 * Serves requests until stdin ends.
 * @param {() => Promise<object>} start makes the runtime; called by the first request
 * @param {Function} write stdout's own, as `takeStdout` gives it
 */
export async function serve(start, write) {
  const commands = commandsOn(new Map());
  let runtime;
  let breakdown = null;

  const answer = async ({ problem, header, bodies }) => {
    try {
      if (problem !== undefined) throw new Error(problem);
      if (!Object.hasOwn(commands, header.cmd)) throw new Error(`unknown command ${JSON.stringify(header.cmd)}`);
      if (breakdown !== null) throw breakdown;
      // Started by the first request and not before, so that a missing package is an answer and not a dead process.
      runtime ??= start();
      const [fields, bytes = []] = await commands[header.cmd](await runtime, header, bodies);
      return [{ ok: true, ...fields }, bytes];
    } catch (error) {
      if (error instanceof WebAssembly.RuntimeError) {
        // A trap. What was being written when it happened is half written, and some kernels of tfjs write past the end
        // of their results (4 bytes for each bool), so the memory holds anything now, the weights included: an answer
        // that looks right could be wrong.
        const message = `WebAssembly broke down, start a new process: ${error.message}`;
        breakdown ??= new WebAssembly.RuntimeError(message);
        return [{ ok: false, error: breakdown.message, broken: true }, []];
      }
      // A page that is gone, or what was in it (browser.mjs): no request can be answered any more.
      if (error?.broken) return [{ ok: false, error: error.message, broken: true }, []];
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

/**
 * A parent that is killed closes stdin, which is noticed between requests only. A worker looks during one, too, unless
 * the kernel does (confinement.py): it takes as long to start as a policy to load.
 */
export function endWithParent() {
  if (process.env.EXPORT_MODEL_KILLED_WITH === String(process.ppid)) return;
  const look = "if (process.ppid !== parent) process.kill(process.pid, 'SIGKILL')";
  new Worker(`const parent = process.ppid; setInterval(() => { ${look}; }, 1000);`, { eval: true }).unref();
}
