/**
 * Runs models in a JavaScript runtime for a parent process, over frames on stdin and stdout (serve.mjs, frames.mjs).
 *
 *     node runner.mjs --runtime tfjs-cpu|tfjs-wasm|onnxruntime-web --modules DIR [--known]
 *
 * DIR holds node_modules with the packages of package.json; this file may lie elsewhere, as in site-packages. With
 * --known nothing else of them is run than what installed.json lists. Ends with
 * status 0 at the end of stdin, 1 where the frames cannot be followed any more (a last answer says so), 2 on a bad
 * command line.
 */

import process from "node:process";
import { parseArgs } from "node:util";
import v8 from "node:v8";

import { FramingError, takeStdout } from "./frames.mjs";
import { onlyKnown } from "./installed.mjs";
import { endWithParent, serve } from "./serve.mjs";

/** Each is imported by the first request: a process holds one runtime and needs no other's code. */
const RUNTIMES = {
  "tfjs-cpu": async (modules) => (await import("./tfjs_node.mjs")).start("cpu", modules),
  "tfjs-wasm": async (modules) => (await import("./tfjs_node.mjs")).start("wasm", modules),
  "onnxruntime-web": async (modules) => (await import("./onnxruntime_node.mjs")).start(modules),
};

function commandLine() {
  const text = { type: "string" };
  const { values } = parseArgs({ options: { runtime: text, modules: text, known: { type: "boolean" } } });
  const { runtime = "", modules, known = false } = values;
  if (!Object.hasOwn(RUNTIMES, runtime)) throw new Error(`--runtime must be one of ${Object.keys(RUNTIMES)}`);
  if (modules === undefined) throw new Error("--modules DIR is missing: the folder that holds node_modules");
  return { runtime, modules, known };
}

/**
 * How much a function of WebAssembly computes before V8 compiles it again, to be faster: 50 times as much as by default.
 * Most policies are done before; of onnxruntime-web's processor time it was half, for a residual network as well.
 */
const TIERING_BUDGET = 100_000_000;

async function main() {
  v8.setFlagsFromString(`--wasm-tiering-budget=${TIERING_BUDGET}`);
  endWithParent();
  const write = takeStdout();
  let options;
  try {
    options = commandLine();
  } catch (error) {
    console.error(`runner.mjs: ${error.message}`);
    return 2;
  }
  try {
    const start = async () => {
      if (options.known) onlyKnown(options.modules);
      return RUNTIMES[options.runtime](options.modules);
    };
    await serve(start, write);
    return 0;
  } catch (error) {
    console.error(`runner.mjs: ${error instanceof FramingError ? error.message : error.stack}`);
    return 1;
  }
}

process.exitCode = await main();
