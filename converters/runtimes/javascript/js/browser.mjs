/**
 * Runs models in Chromium for a parent process, over the frames of converters/files/children/frames.py on stdin and stdout.
 *
 *     node browser.mjs --runtime NAME --modules DIR --chromium FILE [--known]
 *
 * NAME is one of RUNTIMES; DIR holds node_modules with the packages of package.json; FILE is Chromium's program. The
 * commands are those of the runtimes in Node (runner.mjs), and so is --known; `path` in `load` is a folder with model.json
 * or an .onnx.
 *
 * Chromium starts with the first request, so that a missing package is an answer and not a dead process. What the page
 * needs comes from a server of this process on 127.0.0.1 (browser_server.mjs); no name is looked up, so a page that
 * asked for anything else would fail. Everything Chromium writes lies in one temporary folder, which goes with this
 * process; where that was killed, Chromium ends by itself (its pipe is closed) and a start on a later day removes the
 * folder.
 *
 * Status 0 at the end of stdin, 1 where the frames cannot be followed any more, 2 on a bad command line.
 */

import { mkdtempSync, readdirSync, rmSync, statSync } from "node:fs";
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import os from "node:os";
import path from "node:path";
import process from "node:process";
import { parseArgs } from "node:util";

import { PageServer } from "./browser_server.mjs";
import { FramingError, takeStdout } from "./frames.mjs";
import { onlyKnown } from "./installed.mjs";
import { serve } from "./serve.mjs";
import { readArtifacts } from "./tfjs_node.mjs";

const RUNTIMES = ["tfjs-cpu@chromium", "tfjs-wasm@chromium", "tfjs-webgl", "onnxruntime-web@chromium", "litert-web"];
const FOLDER_PREFIX = "export-model-browser-";
const STALE_MILLISECONDS = 24 * 3600 * 1000;

const COMMON_FLAGS = [
  "--disable-quic",
  "--disable-sync",
  // No look-ups: the page has all it needs, and a closed network answers Chromium's own with long waits.
  "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
];
/** WebGL by the software renderer, on every machine: what is verified must not depend on the graphics card. */
const WEBGL_FLAGS = [
  "--use-gl=angle",
  "--use-angle=swiftshader",
  "--enable-unsafe-swiftshader",
  "--ignore-gpu-blocklist",
];

// ---- the folder -----------------------------------------------------------------------------------------------------

/** A temporary folder. Those that killed processes left are removed a day later, when no run can be using them. */
function ownFolder(root) {
  for (const name of readdirSync(root).filter((entry) => entry.startsWith(FOLDER_PREFIX))) {
    const left = path.join(root, name);
    // Another process may just have removed it.
    const age = Date.now() - (statSync(left, { throwIfNoEntry: false })?.mtimeMs ?? Date.now());
    if (age > STALE_MILLISECONDS) remove(left);
  }
  return mkdtempSync(path.join(root, FOLDER_PREFIX));
}

/** The environment in which `folder` is the one for temporary files. */
const temporary = (folder) => ({ TMPDIR: folder, TMP: folder, TEMP: folder });

/** Removes a folder that a dying Chromium may still write to. What cannot be removed now, a later start removes. */
function remove(folder) {
  try {
    rmSync(folder, { recursive: true, force: true, maxRetries: 5, retryDelay: 50 });
  } catch (error) {
    console.error(`browser.mjs: ${folder} is left: ${error.message}`);
  }
}

/** What Playwright says of a failed launch, without the command line and its own steps. */
function reason(error) {
  const [first, ...rest] = error.message.split("\nCall log:")[0].split("\n");
  const said = rest.filter((line) => /FATAL|ERROR|error|exitCode/.test(line) && !line.includes("<launching>"));
  return [first, ...said].join("\n");
}

// ---- the browser ----------------------------------------------------------------------------------------------------

/** Chromium with one page, which runs one runtime; itself a runtime as serve.mjs wants it. */
class Browser {
  #server;
  #browser;
  #loaded = 0;

  constructor(name) {
    this.name = name;
  }

  async open(modules, executablePath) {
    const home = path.resolve(modules);
    const { chromium } = createRequire(path.join(home, "package.json"))("playwright-core");
    this.#server = await PageServer.start(path.join(home, "node_modules"));
    const root = os.tmpdir();
    const folder = ownFolder(root);
    Object.assign(process.env, temporary(folder)); // for the profile that Playwright makes
    try {
      this.#browser = await chromium.launch({
        executablePath,
        args: [...COMMON_FLAGS, ...(this.name === "tfjs-webgl" ? WEBGL_FLAGS : ["--disable-gpu"])],
        // The address of a socket is at most 104 bytes long (macOS), and Chromium appends 45.
        env: { ...process.env, ...temporary(folder.length < 59 ? folder : root) },
        timeout: 120_000, // a machine that does other work starts it slowly
        ...{ handleSIGINT: false, handleSIGTERM: false, handleSIGHUP: false }, // main does
      });
    } catch (error) {
      throw new Error(`Chromium did not start: ${reason(error)}`);
    } finally {
      process.on("exit", () => remove(folder)); // behind Playwright's own, which kills what is left of Chromium
    }
    await this.#openPage();
    const { version, device } = await this.#ask({ call: "start" });
    const drawing = device === null ? "" : ` (${/SwiftShader/.exec(device)?.[0] ?? device})`;
    this.version = `${version} in Chromium ${this.#browser.version()}${drawing}`;
  }

  async #openPage() {
    const server = this.#server;
    this.#browser.on("disconnected", () => server.fail(new Error("Chromium ended")));
    const page = await this.#browser.newPage();
    page.on("crash", () => server.fail(new Error("the page crashed: it ran out of memory, or Chromium has a fault")));
    page.on("pageerror", (error) => server.fail(error));
    page.on("console", (message) => console.error(message.text()));
    await page.goto(`${server.url}page?${new URLSearchParams({ runtime: this.name })}`);
  }

  /** The fields of the page's answer, its bodies among them as `bodies`. */
  async #ask(fields, bodies) {
    const answer = await this.#server.ask(fields, bodies).catch((error) => {
      throw Object.assign(error, { broken: true }); // the page is gone, and the models with it
    });
    const { error, trapped } = answer.fields;
    if (trapped) throw new WebAssembly.RuntimeError(error);
    if (error !== undefined) throw new Error(error);
    return { ...answer.fields, bodies: answer.bodies };
  }

  /** The page reads no files, so the model travels in the request. */
  async load({ path: place, signature }) {
    const id = ++this.#loaded;
    const { inputs, outputs } = await this.#ask(...(await this.#loading(id, place, signature)));
    return { id, inputs, outputs };
  }

  async #loading(id, place, signature) {
    if (!this.name.startsWith("tfjs")) return [{ call: "load", id, signature }, [await readFile(place)]];
    const { weightData, ...artifacts } = await readArtifacts(place);
    return [{ call: "load", id, artifacts }, [new Uint8Array(weightData)]];
  }

  async run({ id }, header, bodies) {
    const answer = await this.#ask({ call: "run", id, header }, bodies);
    return [answer.tensors, answer.bodies];
  }

  unload({ id }) {
    return this.#ask({ call: "unload", id });
  }

  async memory() {
    return (await this.#ask({ call: "memory" })).counts;
  }

  async close() {
    this.#server?.close();
    await this.#browser?.close();
  }
}

// ---- the process ----------------------------------------------------------------------------------------------------

function commandLine() {
  const text = { type: "string" };
  const { values } = parseArgs({ options: { runtime: text, modules: text, chromium: text, known: { type: "boolean" } } });
  if (!RUNTIMES.includes(values.runtime)) throw new Error(`--runtime must be one of ${RUNTIMES.join(", ")}`);
  for (const name of ["modules", "chromium"]) if (values[name] === undefined) throw new Error(`--${name} is missing`);
  return values;
}

async function main() {
  const write = takeStdout();
  let options;
  try {
    options = commandLine();
  } catch (error) {
    console.error(`browser.mjs: ${error.message}`);
    return 2;
  }
  const browser = new Browser(options.runtime);
  let opening;
  const start = async () => {
    if (options.known) onlyKnown(options.modules);
    opening = browser.open(options.modules, options.chromium);
    await opening;
    return browser;
  };
  const end = async (status) => {
    await opening?.catch(() => {}); // a Chromium that is just starting could not be found again
    await browser.close();
    process.exit(status);
  };
  for (const signal of ["SIGINT", "SIGTERM", "SIGHUP"]) {
    process.once(signal, () => void end(128 + os.constants.signals[signal]));
  }
  const parent = process.ppid; // one that is killed closes stdin, which is noticed between requests only
  setInterval(() => process.ppid === parent || void end(1), 1000).unref();
  try {
    await serve(start, write);
    return 0;
  } catch (error) {
    console.error(`browser.mjs: ${error instanceof FramingError ? error.message : error.stack}`);
    return 1;
  } finally {
    await browser.close();
  }
}

// Nothing that a package left open may keep the process: the parent waits for its end.
process.exit(await main());
