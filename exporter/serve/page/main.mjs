/** Puts the page together: the policy, its scene or its panel, and the check. */

import { $, h } from "./dom.mjs";
import { isOneFile, json } from "./files.mjs";
import { Host } from "./host.mjs";
import { asked, tell } from "./link.mjs";
import { engine, Names } from "./names.mjs";
import { Panel } from "./panel.mjs";
import { Stage } from "./stage.mjs";
import { Verdict } from "./verdict.mjs";
import { viewOf } from "./views/index.mjs";

/** The policy's own module plays at once; WebAssembly is faster on images. */
function preferred(contract, backends) {
  const images = contract.inputs.some(({ role }) => role === "visual_observation");
  const names = backends.map(({ name }) => name);
  return [...new Set([asked("on"), ...(images ? ["wasm"] : []), "js", ...names])].filter((name) => names.includes(name));
}

async function started(host, backends) {
  const failed = [];
  for (const backend of backends) {
    try {
      await host.start(backend);
      return;
    } catch (error) {
      failed.push(`${engine(backend)}: ${error.message}`);
    }
  }
  throw new Error(`nothing runs the policy here (${failed.join("; ")})`);
}

function header(site, contract) {
  document.title = `${site.name} · export-model`;
  $("name").textContent = site.name;
  const seen = contract.inputs.filter(({ role }) => role.endsWith("observation"));
  const facts = [
    contract.family + (contract.algorithm ? `, ${contract.algorithm}` : ""),
    `${contract.action_space} actions${contract.branches.length ? ` [${contract.branches.join(", ")}]` : ""}`,
    ...seen.map(({ name, shape }) => `${name} [${shape.slice(1).map((n) => n ?? "any").join(", ")}]`),
    contract.memory ? `memory of ${contract.memory.size}` : "",
    `${(site.model_bytes / 1000).toFixed(0)} kB`,
  ];
  $("facts").textContent = facts.filter(Boolean).join(" · ");
  const runs = site.tfjs === null || isOneFile ? "its own code" : `its own code and TensorFlow.js ${site.tfjs}`;
  $("footer").textContent = `Written by export-model ${site.version}, runs ${runs} in this page. Nothing leaves your browser.`;
}

function chooser(site, host, after) {
  const select = $("backend");
  select.append(...site.backends.map(({ name }) => h("option", { value: name, selected: name === host.backend }, engine(name))));
  select.disabled = false;
  select.addEventListener("change", async () => {
    const wanted = select.value;
    select.disabled = true;
    try {
      await host.start(wanted);
      problem("");
      tell("on", wanted);
      after();
    } catch (error) {
      problem(`${engine(wanted)} cannot be used: ${error.message}. The policy stays on ${engine(host.backend)}.`);
    }
    select.value = host.backend;
    select.disabled = false;
    select.focus();
  });
}

function problem(words) {
  $("problem").textContent = words;
  $("problem").hidden = words === "";
}

async function main() {
  const [site, contract] = await Promise.all([json("site.json"), json("policy.json")]);
  header(site, contract);
  const host = new Host(site.backends);
  await host.fetch(site.models);
  await started(host, preferred(contract, site.backends));
  $("loading").remove();
  const view = site.scene === null ? null : viewOf(site);
  const names = new Names(contract, contract.labels, view?.labels);
  const stage = view === null ? null : new Stage(view, host, names, site.backends);
  // First it plays. What takes time, the panel and the check, begins once it has moved.
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) await stage?.play();
  const panel = new Panel(host, names, { folded: view !== null });
  const verdict = new Verdict(host, site);
  chooser(site, host, () => {
    void panel.decide();
    stage?.retitle();
  });
  await verdict.run();
}

main().catch((error) => {
  $("loading")?.remove();
  $("verdict").textContent = "Not checked.";
  problem(`The policy cannot be shown: ${error.message}`);
});
