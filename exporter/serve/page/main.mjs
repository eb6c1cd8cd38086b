/** Puts the page together: the policy, its scene or its panel, and the check. */

import { $, h } from "./dom.mjs";
import { Host } from "./host.mjs";
import { Names } from "./names.mjs";
import { Panel } from "./panel.mjs";
import { Stage } from "./stage.mjs";
import { Verdict } from "./verdict.mjs";
import { viewOf } from "./views/index.mjs";

async function fetched(name) {
  const answer = await fetch(name);
  if (!answer.ok) throw new Error(`${name} is not there (HTTP status ${answer.status})`);
  return answer.json();
}

/** Small networks are fastest on the processor; images are not. */
function preferred(contract, backends) {
  const images = contract.inputs.some(({ role }) => role === "visual_observation");
  const names = backends.map(({ name }) => name);
  return [...new Set([...(images ? ["wasm"] : []), "cpu", ...names])].filter((name) => names.includes(name));
}

async function started(host, backends) {
  const failed = [];
  for (const backend of backends) {
    try {
      await host.start(backend);
      return;
    } catch (error) {
      failed.push(`${backend}: ${error.message}`);
    }
  }
  throw new Error(`no backend of TensorFlow.js runs the policy here (${failed.join("; ")})`);
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
  $("footer").textContent =
    `Written by export-model ${site.version}, runs TensorFlow.js ${site.tfjs} in this page. Nothing leaves your browser.`;
}

function chooser(site, host, after) {
  const select = $("backend");
  select.append(...site.backends.map(({ name }) => h("option", { value: name, selected: name === host.backend }, name)));
  select.disabled = false;
  select.addEventListener("change", async () => {
    const asked = select.value;
    select.disabled = true;
    try {
      await host.start(asked);
      problem("");
      after();
    } catch (error) {
      problem(`${asked} cannot be used: ${error.message}. The policy stays on ${host.backend}.`);
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
  if (globalThis.tf === undefined) throw new Error("TensorFlow.js did not load (vendor/tf.es2017.min.js)");
  const [site, contract] = await Promise.all([fetched("site.json"), fetched("policy.json")]);
  header(site, contract);
  const models = { model: "model/model.json", ...(site.opponent !== null && { opponent: "opponent/model.json" }) };
  const host = new Host(globalThis.tf, site.backends, models);
  await host.fetch();
  await started(host, preferred(contract, site.backends));
  const view = site.scene === null ? null : viewOf(site);
  const names = new Names(contract, contract.labels, view?.labels);
  const stage = view === null ? null : new Stage(view, host, names);
  const panel = new Panel(host, names, { folded: view !== null });
  const verdict = new Verdict(host, site.backends, site.absent);
  chooser(site, host, () => panel.decide());
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  await verdict.run(() => calm || stage?.play());
}

main().catch((error) => {
  $("verdict").textContent = "Not checked.";
  problem(`The policy cannot be shown: ${error.message}`);
});
