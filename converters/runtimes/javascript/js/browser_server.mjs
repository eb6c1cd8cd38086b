/**
 * The server on 127.0.0.1 that a page is loaded from and asked over.
 *
 * The page pulls: it POSTs its last answer to `exchange`, and the response, which may be long in coming, is the next
 * request. So tensors cross as raw bytes (envelope.mjs), one round trip a request. Every address begins with a token
 * that only this process and its page know.
 */

import { randomBytes } from "node:crypto";
import { readFile } from "node:fs/promises";
import http from "node:http";
import path from "node:path";
import { fileURLToPath } from "node:url";

import { pack, unpack } from "./envelope.mjs";

const SCRIPTS = path.dirname(fileURLToPath(import.meta.url));
const LITERT = path.resolve(SCRIPTS, "../../litert");
const TYPES = { ".js": "text/javascript", ".mjs": "text/javascript", ".wasm": "application/wasm" };
/** LiteRT.js names its other package as a bundler would find it. */
const IMPORTS = { "@litertjs/wasm-utils": "./modules/@litertjs/wasm-utils/dist/index.js" };
const PAGE = `<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,"><title>export-model</title>
<script type="importmap">${JSON.stringify({ imports: IMPORTS })}</script>
<script type="module" src="scripts/browser_page.mjs"></script>`;

export class PageServer {
  /** Where the page is: everything else lies relative to it. */
  url = "";
  #token = randomBytes(16).toString("hex");
  #modules;
  #server = http.createServer((request, response) => void this.#serve(request, response));
  /** The response that the page waits for; null while the page is at work. */
  #waiting = null;
  /** The request that waits for the page; null while it has none. */
  #asked = null;
  #failure = null;

  constructor(modules) {
    this.#modules = modules;
    // The page's connection is idle while a model runs. Node would close it, perhaps just as the answer comes.
    this.#server.keepAliveTimeout = 0;
    this.#server.requestTimeout = 0;
  }

  /** @param {string} modules the folder node_modules */
  static async start(modules) {
    const self = new PageServer(modules);
    await new Promise((resolve, reject) => {
      self.#server.once("error", reject);
      self.#server.listen(0, "127.0.0.1", resolve);
    });
    self.url = `http://127.0.0.1:${self.#server.address().port}/${self.#token}/`;
    return self;
  }

  /**
   * @param {object} fields
   * @param {Uint8Array[]} bodies
   * @returns {Promise<{fields: object, bodies: Uint8Array[]}>} what the page answers; one request at a time
   */
  ask(fields, bodies = []) {
    if (this.#failure !== null) return Promise.reject(this.#failure);
    return new Promise((resolve, reject) => {
      this.#asked = { request: Buffer.concat(pack(fields, bodies)), resolve, reject };
      this.#send();
    });
  }

  /** The page is gone: what was asked and what will be asked fails. */
  fail(error) {
    this.#failure ??= error;
    this.#asked?.reject(this.#failure);
    this.#asked = null;
  }

  close() {
    this.fail(new Error("the browser is closed"));
    this.#server.close();
    this.#server.closeAllConnections();
  }

  #send() {
    if (this.#waiting === null || !this.#asked?.request) return;
    const { request } = this.#asked;
    this.#asked.request = null; // sent: the next exchange brings its answer
    this.#waiting.writeHead(200, { "content-type": "application/octet-stream", "content-length": request.length });
    this.#waiting.end(request);
    this.#waiting = null;
  }

  async #serve(request, response) {
    try {
      const { pathname } = new URL(request.url, "http://127.0.0.1");
      const [, token, kind, ...rest] = pathname.split("/").map(decodeURIComponent);
      if (token !== this.#token) throw new Error("not this page's address");
      if (kind === "exchange" && request.method === "POST") return await this.#exchange(request, response);
      if (kind === "page") return void response.writeHead(200, { "content-type": "text/html" }).end(PAGE);
      const root = { scripts: SCRIPTS, litert: LITERT, modules: this.#modules }[kind];
      if (root === undefined) throw new Error(`nothing called ${kind}`);
      const file = path.resolve(root, ...rest);
      if (!file.startsWith(root + path.sep)) throw new Error("outside of the packages");
      const content = await readFile(file);
      return void response.writeHead(200, { "content-type": TYPES[path.extname(file)] ?? "text/plain" }).end(content);
    } catch (error) {
      return void response.writeHead(404, { "content-type": "text/plain" }).end(error.message);
    }
  }

  async #exchange(request, response) {
    const parts = [];
    for await (const part of request) parts.push(part);
    // The first exchange answers nothing: the page says that it is there.
    if (parts.length > 0) {
      this.#asked?.resolve(unpack(Buffer.concat(parts)));
      this.#asked = null;
    }
    this.#waiting = response;
    this.#send();
  }
}
