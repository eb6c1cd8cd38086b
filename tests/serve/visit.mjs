/**
 * Opens pages in a Chromium, each in a context of its own, and does there what a line of stdin says; prints what was seen
 * as a line of JSON.
 *
 *     node visit.mjs MODULES CHROMIUM < {"url", "context": {…}, "steps": [[verb, …arguments], …]}
 *
 * `results` has an entry per step, `console` what was written there as a warning or an error, `requests` every address
 * that was asked for.
 */

import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import path from "node:path";
import process from "node:process";
import { createInterface } from "node:readline";

/** In ms: more than a busy machine takes, so that what never comes is a failure and not a hang. */
const PATIENCE = 300_000;
const FLAGS = [
  "--no-sandbox",
  "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
  ...["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"],
];

const [modules, executablePath] = process.argv.slice(2);
const { chromium } = createRequire(path.join(path.resolve(modules), "package.json"))("playwright-core");
const browser = await chromium.launch({ executablePath, args: FLAGS, timeout: PATIENCE });
browser.on("disconnected", () => process.exit()); // who is not answered starts another
for await (const line of createInterface({ input: process.stdin })) console.log(JSON.stringify(await visited(JSON.parse(line))));
await browser.close();

async function visited({ url, context, steps }) {
  const opened = [];
  let reader; // a page of its own, which decodes pictures
  const seen = { results: [], console: [], requests: [] };
  try {
    opened.push(await browser.newContext(context));
    const page = await opened[0].newPage();
    page.setDefaultTimeout(PATIENCE);
    page.on("console", (message) => {
      if (["warning", "error"].includes(message.type())) seen.console.push(`${message.type()}: ${message.text()}`);
    });
    page.on("pageerror", (error) => seen.console.push(`pageerror: ${error.stack}`));
    page.on("request", (request) => seen.requests.push(request.url()));
    await page.goto(url);
    const verbs = {
      // Not waitForFunction: it evaluates inside the page, whose policy forbids that.
      async wait(expression) {
        const end = Date.now() + PATIENCE;
        while (!(await page.evaluate(expression))) {
          if (Date.now() > end) throw new Error(`it never came to pass that ${expression}`);
          await page.waitForTimeout(100);
        }
      },
      eval: (expression) => page.evaluate(expression),
      click: (selector) => page.click(selector),
      select: async (selector, value) => void (await page.selectOption(selector, value)),
      fill: (selector, value) => page.fill(selector, value),
      focus: (selector) => page.focus(selector),
      press: (key) => page.keyboard.press(key),
      /** From one place of an element to another, in shares of its size; in one move, as a busy browser reports a hand. */
      async drag(selector, from, to) {
        const box = await page.locator(selector).boundingBox();
        const at = ([x, y]) => [box.x + x * box.width, box.y + y * box.height];
        await page.mouse.move(...at(from));
        await page.mouse.down();
        await page.mouse.move(...at(to));
        await page.mouse.up();
      },
      /** Files ([name, base64], …) are dropped on the page. */
      async drop(files) {
        await page.evaluate((given) => {
          const dataTransfer = new DataTransfer();
          for (const [name, data] of given) {
            const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
            dataTransfer.items.add(new File([bytes], name));
          }
          document.dispatchEvent(new DragEvent("drop", { dataTransfer, bubbles: true, cancelable: true }));
        }, files);
      },
      /** What an element looks like: its pixels, RGBA. */
      async pixels(selector) {
        const png = (await page.locator(selector).screenshot()).toString("base64");
        if (reader === undefined) {
          opened.push(await browser.newContext());
          reader = await opened[1].newPage();
        }
        return reader.evaluate(async (data) => {
          const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
          const image = await createImageBitmap(new Blob([bytes]));
          const context = new OffscreenCanvas(image.width, image.height).getContext("2d");
          context.drawImage(image, 0, 0);
          const raw = context.getImageData(0, 0, image.width, image.height).data;
          let text = "";
          for (let at = 0; at < raw.length; at += 30000) text += String.fromCharCode(...raw.subarray(at, at + 30000));
          return { width: image.width, height: image.height, data: btoa(text) };
        }, png);
      },
      viewport: (width, height) => page.setViewportSize({ width, height }),
      scheme: (colorScheme) => page.emulateMedia({ colorScheme }),
      /** What axe-core finds: [rule, how bad, the elements] each. */
      async axe(file) {
        if (!(await page.evaluate("'axe' in window"))) await page.evaluate(await readFile(file, "utf8"));
        const { violations } = await page.evaluate(() => globalThis.axe.run(document, { resultTypes: ["violations"] }));
        return violations.map(({ id, impact, nodes }) => [id, impact, nodes.map(({ html, any }) => [html.slice(0, 160), any[0]?.message])]);
      },
      shot: async (file, fullPage = true) => void (await page.screenshot({ path: file, fullPage })),
    };
    for (const [verb, ...rest] of steps) seen.results.push((await verbs[verb](...rest)) ?? null);
  } catch (error) {
    seen.failure = error.message;
  } finally {
    for (const each of opened) await each.close();
  }
  return seen;
}
