/**
 * Two TensorFlow.js graph models, called in turn: `node latency.mjs TFJS_NODE MODULES BACKEND BATCH ROUNDS OURS THEIRS`
 * prints [seconds of ours, seconds of theirs], the medians of the rounds.
 */

import { createRequire } from "node:module";
import path from "node:path";
import { pathToFileURL } from "node:url";

const [tfjsNode, modules, backend, batch, rounds, ...folders] = process.argv.slice(2);
const { start, readArtifacts } = await import(pathToFileURL(path.resolve(tfjsNode)));
await start(backend, modules);
const require = createRequire(path.join(path.resolve(modules), "package.json"));
const tf = require("@tensorflow/tfjs-core");
const { loadGraphModel } = require("@tensorflow/tfjs-converter");

const sides = [];
for (const folder of folders) {
  const artifacts = await readArtifacts(folder);
  const model = await loadGraphModel({ load: async () => artifacts });
  const size = (n) => (n > 0 ? n : Number(batch));
  const feeds = model.inputs.map(({ shape, dtype }) => tf.fill(shape.map(size), dtype === "int32" ? 1 : 0.5, dtype));
  sides.push(() => tf.tidy(() => [model.predict(feeds)].flat().forEach((t) => (t.dataSync ? t : Object.values(t)[0]).dataSync())));
}
const times = sides.map(() => []);
for (let round = -10; round < Number(rounds); round += 1) {
  sides.forEach((call, side) => {
    const begin = process.hrtime.bigint();
    for (let i = 0; i < 20; i += 1) call();
    if (round >= 0) times[side].push(Number(process.hrtime.bigint() - begin) / 20e9);
  });
}
console.log(JSON.stringify(times.map((all) => all.sort((a, b) => a - b)[all.length >> 1])));
