/**
 * The `js` runtime in Node: graph models run by the kernels beside this file, over frames on stdin and stdout.
 *
 *     node runner.mjs VERSION
 */

import process from "node:process";

import { Generator } from "../../formats/tfjs/js/policy.mjs";
import { takeStdout } from "../javascript/js/frames.mjs";
import { endWithParent, serve } from "../javascript/js/serve.mjs";
import { readArtifacts } from "../javascript/js/tfjs_node.mjs";
import { GraphModel } from "./kernels/model.mjs";

const [version] = process.argv.slice(2);

/** What a frame carries, as a tensor. */
function toTensor({ name, dtype, shape }, body) {
  const data = body.buffer.slice(body.byteOffset, body.byteOffset + body.byteLength);
  const takes = { float32: Float32Array, int32: Int32Array, bool: Uint8Array, int64: BigInt64Array };
  if (takes[dtype] === undefined) throw new Error(`tensor '${name}' is ${dtype}; float32, int32, int64 and bool are taken`);
  const values = new takes[dtype](data);
  if (dtype !== "int64") return { dtype, shape, data: values };
  const narrow = Int32Array.from(values, (value) => {
    if (value !== BigInt.asIntN(32, value)) throw new Error(`tensor '${name}': ${value} does not fit int32`);
    return Number(value);
  });
  return { dtype: "int32", shape, data: narrow };
}

/** One for the process: two models do not draw alike, two runs do. */
const generator = new Generator(0);

const runtime = {
  name: "js",
  version,
  load: async ({ path }) => new GraphModel(await readArtifacts(path), { random: () => generator.uniform() }),
  run(model, { tensors = [], fetch }, bodies) {
    const feeds = Object.fromEntries(tensors.map((spec, i) => [spec.name, toTensor(spec, bodies[i])]));
    const results = Object.entries(model.run(feeds, fetch));
    const bytes = results.map(([, { data }]) => new Uint8Array(data.buffer, data.byteOffset, data.byteLength));
    return [results.map(([name, { dtype, shape }]) => ({ name, dtype, shape })), bytes];
  },
  unload() {},
  memory: () => ({}),
};

endWithParent();
await serve(() => runtime, takeStdout());
