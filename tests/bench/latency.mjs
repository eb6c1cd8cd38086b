/**
 * Two TensorFlow.js graph models, called in turn:
 *
 *     node latency.mjs TFJS_NODE MODULES BACKEND BATCH ROUNDS OURS OUTPUTS THEIRS OUTPUTS [CHROMIUM]
 *
 * prints [[smallest, median] of ours, [smallest, median] of theirs], seconds of a call that fetches OUTPUTS (names of nodes,
 * by commas). With the backend webgl the calls are made in a page of Chromium, by the clock; else by the processor's time.
 */

import { createRequire } from "node:module";
import path from "node:path";
import { pathToFileURL } from "node:url";

const CALLS = 20;
const [tfjsNode, modules, backend, batch, rounds, ours, own, theirs, others, executablePath] = process.argv.slice(2);
const { start, readArtifacts } = await import(pathToFileURL(path.resolve(tfjsNode)));
const require = createRequire(path.join(path.resolve(modules), "package.json"));

/** The times of each model's rounds. It runs in a page as well, so it knows nothing of this file. */
async function measure(tf, load, now, models, { batch, rounds, outputs, calls }) {
  const sides = [];
  for (const [side, artifacts] of models.entries()) {
    const model = await load({ load: async () => artifacts });
    // A source's own batch size is fed as well; the length of its sequences is 1.
    const fill = (name, dtype) => (name.startsWith("batch_size") ? batch : dtype === "int32" ? 1 : 0.5);
    const size = (n) => (n > 0 ? n : batch);
    const feeds = {};
    for (const { name, shape, dtype } of model.inputs) feeds[name] = tf.fill((shape ?? []).map(size), fill(name, dtype), dtype);
    sides.push(async () => {
      const kept = new Set(Object.values(feeds).map((t) => t.id));
      let results;
      try {
        results = model.execute(feeds, outputs[side]);
      } catch {
        results = await model.executeAsync(feeds, outputs[side]); // while loops
      }
      for (const tensor of [results].flat()) {
        tensor.dataSync();
        if (!kept.has(tensor.id)) tensor.dispose();
      }
    });
  }
  const times = sides.map(() => []);
  for (let round = -10; round < rounds; round += 1) {
    for (const [side, call] of sides.entries()) {
      const begin = now();
      for (let i = 0; i < calls; i += 1) await call();
      if (round >= 0) times[side].push((now() - begin) / calls);
    }
  }
  return times.map((all) => all.sort((a, b) => a - b)).map((all) => [all[0], all[all.length >> 1]]);
}

async function inNode(models, options) {
  await start(backend, modules);
  const processor = () => {
    const { user, system } = process.cpuUsage();
    return (user + system) / 1e6;
  };
  const { loadGraphModel } = require("@tensorflow/tfjs-converter");
  return measure(require("@tensorflow/tfjs-core"), loadGraphModel, processor, models, options);
}

async function inPage(models, options) {
  const { chromium } = require("playwright-core");
  const args = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"];
  const browser = await chromium.launch({ executablePath, args });
  try {
    const page = await browser.newPage();
    await page.addScriptTag({ path: path.join(path.resolve(modules), "node_modules/@tensorflow/tfjs/dist/tf.min.js") });
    const sent = models.map((m) => ({ ...m, weightData: Array.from(new Uint8Array(m.weightData)) }));
    return await page.evaluate(`(async () => {
      await tf.setBackend("webgl");
      const models = ${JSON.stringify(sent)}.map((m) => ({ ...m, weightData: Uint8Array.from(m.weightData).buffer }));
      return (${measure})(tf, tf.loadGraphModel, () => performance.now() / 1000, models, ${JSON.stringify(options)});
    })()`);
  } finally {
    await browser.close();
  }
}

const models = [await readArtifacts(ours), await readArtifacts(theirs)];
const options = { batch: Number(batch), rounds: Number(rounds), outputs: [own.split(","), others.split(",")], calls: CALLS };
console.log(JSON.stringify(await (backend === "webgl" ? inPage : inNode)(models, options)));
