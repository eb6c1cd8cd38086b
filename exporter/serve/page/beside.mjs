/** Policies to put beside the page's own: the same one untrained, and what a visitor drops on the page. */

import { withModule, withOnnx, withTfjs } from "./engines.mjs";
import { artifacts, isOneFile } from "./files.mjs";
import { Policy } from "./policy.mjs";
import { Streams } from "./scenes/base.mjs";

const MOST_BYTES = 200e6;
/** Under which name an ONNX file holds its contract. */
const EMBEDDED = "export_model_contract";

/** The same network with its matrices drawn anew, as before training; what the normaliser knows stays. */
export async function untrained({ contract, ...source }, seed = 1) {
  const random = new Streams(seed, 1);
  const { run } = await withModule(source, (matrices) => {
    for (const [values, columns] of matrices()) {
      const bound = Math.sqrt((6 * columns) / (values.length + columns ** 2));
      values.forEach((_, i) => (values[i] = random.uniform(0, -bound, bound)));
    }
  });
  return new Policy(contract, run, () => {}, 0);
}

/** A contract as far as this page reads it; what it says is shown as text only. */
function checked(held) {
  const contract = typeof held === "string" ? JSON.parse(held) : held;
  const tensors = (list) => Array.isArray(list) && list.every(({ name, role, shape }) => {
    return typeof name === "string" && typeof role === "string" && Array.isArray(shape) && shape.every((n) => n === null || Number.isSafeInteger(n));
  });
  const whole = tensors(contract?.inputs) && tensors(contract?.outputs) && contract.outputs.length > 0 && Array.isArray(contract.branches);
  if (!whole) throw new Error("it holds no contract of export-model: drop what export-model wrote");
  return { ...contract, name: String(contract.name ?? "the other").replace(/[^\w.-]/g, "\ufffd").slice(0, 80) };
}

/** Whether a policy can act in place of another; an Error says what differs. */
export function fitting(own, other) {
  const shape = ({ inputs, action_space: space, branches }) => {
    const seen = inputs.filter(({ role }) => role.endsWith("observation")).map((input) => `[${input.shape.slice(1)}]`);
    return `observations ${seen.join(" ")}, ${space} actions ${branches.length > 0 ? `[${branches}]` : ""}`;
  };
  const [wanted, given] = [shape(own), shape(other)];
  if (wanted !== given) throw new Error(`it takes ${given}; this scene gives ${wanted}`);
}

// ---- what is dropped ------------------------------------------------------------------------------------------------

/** What may be dropped on this page, said before somebody tries. `engines`: the names of its engines. */
export function droppable(engines) {
  if (isOneFile) return "Drop the folder of a bundle here to compare it, exported with --to js: this page runs modules only.";
  if (engines.has("onnxruntime-web")) return "Drop the folder of a bundle here to compare it, or an .onnx that export-model wrote.";
  if (engines.has("cpu")) return "Drop the folder of a bundle here to compare it. An .onnx needs onnxruntime-web, which is not in this page.";
  return "Nothing can be dropped here: it needs TensorFlow.js, or a page of one file.";
}

/**
 * The policy in a drop: a bundle's folder, the files of its tfjs folder, or an `.onnx`. `onnxruntime`: its module's
 * address. A page of one file, which may connect to nothing, runs the bundle's own module; any other runs its data alone.
 */
export async function dropped(items, onnxruntime) {
  const files = new Map();
  const given = Array.from(items, (item) => [item.webkitGetAsEntry?.(), item.getAsFile()]); // gone after the first await
  for (const [entry, file] of given) {
    if (entry) await gather(entry, files);
    else if (file) files.set(`/${file.name}`, file);
  }
  const size = Array.from(files.values()).reduce((sum, file) => sum + file.size, 0);
  if (size > MOST_BYTES) throw new Error("it is larger than 200 MB");
  const find = (end) => Array.from(files.keys()).find((name) => name.endsWith(end));
  const file = (name) => {
    if (!files.has(name)) throw new Error(`${name} is missing`);
    return files.get(name);
  };
  const read = { json: async (name) => JSON.parse(await file(name).text()), bytes: (name) => file(name).arrayBuffer() };
  if (isOneFile) return ofModule(find("/policy.json"), read, (name) => files.has(name));
  const model = find("model.json");
  if (model !== undefined) {
    const source = await artifacts(model.slice(0, -"model.json".length), read);
    const contract = checked(source.userDefinedMetadata?.contract);
    const { run } = await withTfjs("cpu", null)({ artifacts: async () => source });
    return new Policy(contract, run, () => {}, 0);
  }
  const onnx = find(".onnx");
  if (onnx === undefined) throw new Error("it has neither a tfjs/model.json nor an .onnx");
  if (onnxruntime === undefined) throw new Error("an .onnx needs onnxruntime-web, which is not in this page: drop the bundle's folder");
  const bytes = await read.bytes(onnx);
  const contract = checked(metadata(new Uint8Array(bytes), EMBEDDED));
  const { run } = await withOnnx(onnxruntime)({ onnx: async () => bytes });
  return new Policy(contract, run, () => {}, 0);
}

/** The policy of a bundle by its own module, whose file stands beside policy.json. */
async function ofModule(place, read, has) {
  const contract = place === undefined ? undefined : checked(await read.json(place));
  const module = `${place?.slice(0, -"policy.json".length)}${contract?.name}.mjs`;
  if (!has(module)) throw new Error("it has no policy.json with a module beside it: export it with js among --to, and drop its folder");
  const address = URL.createObjectURL(new Blob([await read.bytes(module)], { type: "text/javascript" }));
  const { default: Agent, ports, load } = await import(address);
  const { run } = await withModule({ make: () => ({ Agent, ports, load }), weights: () => read.bytes(module.replace(/\.mjs$/, ".weights.bin")) });
  return new Policy(contract, run, () => {}, 0);
}

async function gather(entry, files, depth = 0) {
  if (files.size > 2000 || depth > 4) throw new Error("it is more than a bundle");
  if (entry.isFile) files.set(entry.fullPath, await new Promise((resolve, reject) => entry.file(resolve, reject)));
  else {
    const reader = entry.createReader();
    for (;;) {
      const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
      if (some.length === 0) break;
      for (const inner of some) await gather(inner, files, depth + 1);
    }
  }
}

/** An entry of an ONNX file's metadata (ModelProto.metadata_props, field 14: key 1, value 2); undefined where it has none. */
export function metadata(bytes, wanted) {
  const text = (part) => new TextDecoder().decode(part);
  for (const [field, part] of fields(bytes)) {
    if (field !== 14) continue;
    const pair = new Map(fields(part));
    if (pair.has(1) && text(pair.get(1)) === wanted) return text(pair.get(2) ?? new Uint8Array());
  }
  return undefined;
}

/** The fields of a protobuf message that are bytes: [number, bytes]. */
function* fields(bytes) {
  let at = 0;
  const varint = () => {
    let [value, scale] = [0, 1];
    for (;;) {
      if (at >= bytes.length || scale > 2 ** 63) throw new Error("the ONNX file is damaged");
      const byte = bytes[at++];
      value += (byte & 127) * scale;
      if (byte < 128) return value;
      scale *= 128;
    }
  };
  while (at < bytes.length) {
    const tag = varint();
    const [field, kind] = [Math.floor(tag / 8), tag % 8];
    if (kind === 0) varint();
    else if (kind === 1) at += 8;
    else if (kind === 5) at += 4;
    else if (kind === 2) {
      const length = varint();
      if (at + length > bytes.length) throw new Error("the ONNX file is damaged");
      yield [field, bytes.subarray(at, at + length)];
      at += length;
    } else throw new Error("the ONNX file is damaged");
  }
}
