/** TensorFlow.js in Node: its packages found in a folder, models read from files. */

import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import path from "node:path";

import { GraphModels } from "./tfjs.mjs";

const BACKENDS = { cpu: "@tensorflow/tfjs-backend-cpu", wasm: "@tensorflow/tfjs-backend-wasm" };

/**
 * The three packages that a graph model needs; the whole of @tensorflow/tfjs would load layers, data and webgl as well.
 * @param {string} backend "cpu" or "wasm"
 * @param {string} modules the folder that holds node_modules
 */
export async function start(backend, modules) {
  const require = createRequire(path.join(path.resolve(modules), "package.json"));
  const tf = require("@tensorflow/tfjs-core");
  const { loadGraphModel } = require("@tensorflow/tfjs-converter");
  const kernels = require(BACKENDS[backend]);
  if (backend === "wasm") kernels.setWasmPaths(path.dirname(require.resolve(BACKENDS.wasm)) + path.sep);
  const models = new GraphModels(tf, loadGraphModel, readArtifacts);
  await models.useBackend(backend);
  return models;
}

/**
 * What `tf.loadGraphModel` takes, from a folder with model.json and its shards.
 * @param {string} folder
 */
export async function readArtifacts(folder) {
  const json = JSON.parse(await readFile(path.join(folder, "model.json"), "utf8"));
  const manifest = json?.weightsManifest ?? [];
  return {
    ...json,
    weightSpecs: manifest.flatMap((group) => group.weights),
    weightData: await readShards(folder, manifest.flatMap((group) => group.paths)),
  };
}

/**
 * The shards, joined into an ArrayBuffer that holds nothing else: tfjs reads `.buffer` of a typed array from its start,
 * and a small Buffer of Node's is a piece of a shared pool.
 */
async function readShards(folder, names) {
  const root = path.resolve(folder);
  const shards = [];
  for (const name of names) {
    const file = path.resolve(root, name);
    // model.json may come from anywhere; it must not make this process read other files.
    if (!file.startsWith(root + path.sep)) throw new Error(`the shard ${name} lies outside the model's folder`);
    shards.push(await readFile(file));
  }
  const joined = new Uint8Array(shards.reduce((sum, shard) => sum + shard.length, 0));
  let offset = 0;
  for (const shard of shards) {
    joined.set(shard, offset);
    offset += shard.length;
  }
  return joined.buffer;
}
