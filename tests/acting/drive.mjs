// Decides with policy.mjs in Node: node drive.mjs MODULES FOLDER NAME tfjs|onnx < requests.json > decisions.json
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import path from "node:path";
import { pathToFileURL } from "node:url";

const [modules, folder, name, kind] = process.argv.slice(2);
const require = createRequire(path.join(modules, "node_modules", "x.js"));
const { loadPolicy, Generator } = await import(pathToFileURL(path.join(folder, "tfjs", "policy.mjs")));

async function open() {
  if (kind === "onnx") {
    const ort = require("onnxruntime-web");
    ort.env.wasm.numThreads = 1;
    ort.env.logLevel = "error";
    const contract = JSON.parse(await readFile(path.join(folder, "policy.json"), "utf8"));
    return loadPolicy(new Uint8Array(await readFile(path.join(folder, `${name}.onnx`))), { ort, contract });
  }
  const tf = { ...require("@tensorflow/tfjs-core"), ...require("@tensorflow/tfjs-converter") };
  require("@tensorflow/tfjs-backend-cpu");
  await tf.setBackend("cpu");
  const json = JSON.parse(await readFile(path.join(folder, "tfjs", "model.json"), "utf8"));
  const shards = await Promise.all(
    json.weightsManifest.flatMap((g) => g.paths).map((p) => readFile(path.join(folder, "tfjs", p))),
  );
  const weightData = new Uint8Array(Buffer.concat(shards)).buffer;
  const weightSpecs = json.weightsManifest.flatMap((g) => g.weights);
  return loadPolicy({ load: async () => ({ ...json, weightSpecs, weightData }) }, { tf });
}

const chunks = [];
for await (const chunk of process.stdin) chunks.push(chunk);
const requests = JSON.parse(Buffer.concat(chunks).toString());
const answers = [];
const policy = await open();
for (const { how = "decide", observations, options = {}, steps } of requests) {
  try {
    if (how === "agent") {
      const agent = policy.agent(options);
      const actions = [];
      for (const step of steps) {
        if (step.reset) agent.reset(step.reset);
        actions.push(plain(await agent.decide(step.observations, step.options)));
      }
      answers.push(actions);
    } else if (how === "generator") {
      const g = new Generator(options.seed);
      answers.push([...Array.from({ length: 5 }, () => g.uniform()), ...Array.from({ length: 5 }, () => g.normal())]);
    } else {
      for (const [name, value] of Object.entries(observations)) {
        if (value?.bytes) observations[name] = Uint8Array.from(value.bytes);
      }
      answers.push(plain(await policy.decide(observations, options)));
    }
  } catch (error) {
    answers.push({ error: error.message });
  }
}
function plain({ continuous, discrete, memory }) {
  return { continuous, discrete, memory: memory && { data: Array.from(memory.data), shape: Array.from(memory.shape) } };
}
policy.dispose();
process.stdout.write(JSON.stringify(answers));
process.exit(0);
