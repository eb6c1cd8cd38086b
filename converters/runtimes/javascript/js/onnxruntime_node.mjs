/** onnxruntime-web in Node: its package found in a folder, models read from files. */

import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import path from "node:path";

import { OnnxModels } from "./onnxruntime.mjs";

/**
 * The build with WebAssembly alone, the one that a page loads with "onnxruntime-web/wasm".
 * @param {string} modules the folder that holds node_modules
 */
export async function start(modules) {
  const require = createRequire(path.join(path.resolve(modules), "package.json"));
  const models = new OnnxModels(require("onnxruntime-web/wasm"), (file) => readFile(file));
  await models.warmUp();
  return models;
}
