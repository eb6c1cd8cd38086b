// Runs the modules of pages in Node: node run_pages.mjs < modules.json > logs.json, in the bundles' folder.
// What a page fetches is a file beside it; a module's console.log is its answer.
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import path from "node:path";
import { pathToFileURL } from "node:url";

globalThis.require = createRequire(import.meta.url); // TensorFlow.js asks for it in Node, pages have none
const base = "http://page.test/";
globalThis.location = { href: base };
globalThis.fetch = async (asked) => {
  const url = new URL(asked?.url ?? asked, base);
  const file = url.protocol === "file:" ? url : path.join(process.cwd(), decodeURIComponent(url.pathname));
  return new Response(await readFile(file), { headers: { "content-type": "application/octet-stream" } });
};

const chunks = [];
for await (const chunk of process.stdin) chunks.push(chunk);
const print = console.log;
const logs = [];
for (const file of JSON.parse(Buffer.concat(chunks).toString())) {
  const lines = [];
  console.log = (...values) => lines.push(values);
  await import(pathToFileURL(file));
  logs.push(lines);
}
console.log = print;
process.stdout.write(JSON.stringify(logs), () => process.exit(0));
