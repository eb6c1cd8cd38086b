/**
 * A graph model of TensorFlow.js, run by the kernels beside this file: no package, no other file, in Node and in a page.
 *
 *     const model = new GraphModel({ ...modelJson, weightData });
 *     const { action } = model.run({ state: { dtype: "float32", shape: [1, 8], data: new Float32Array(8) } });
 *
 * It knows the ops that export-model writes, and takes float32, int32 and bool.
 */

import { MOVING } from "./arrays.mjs";
import { ELEMENTWISE } from "./elementwise.mjs";
import { IMAGES } from "./images.mjs";
import { LINEAR } from "./linear.mjs";
import { SAMPLERS } from "./samplers.mjs";
import { ARRAYS, sizeOf } from "./tensors.mjs";

export const KERNELS = { ...ELEMENTWISE, ...LINEAR, ...IMAGES, ...MOVING, ...SAMPLERS };

/** What other versions of TensorFlow call the same ops. */
const SPELLINGS = {
  AddV2: "Add", Div: "RealDiv", Inv: "Reciprocal", BatchMatMulV2: "BatchMatMul", BatchMatMulV3: "BatchMatMul", Unstack: "Unpack",
};
/** int64 is int32 in TensorFlow.js. */
const DTYPES = { DT_FLOAT: "float32", DT_INT32: "int32", DT_INT64: "int32", DT_BOOL: "bool" };
const DATA = new Set(["Const", "Placeholder", "PlaceholderV2"]);

export class GraphModel {
  #nodes = new Map();
  #constants;
  #random;
  /** The nodes to run for a list of outputs, by that list. */
  #plans = new Map();

  /**
   * @param {{modelTopology: object, weightsManifest: object[], weightData: ArrayBuffer, signature?: object}} artifacts
   *   model.json's fields, and the shards joined
   * @param {{random?: () => number}} options uniform numbers in [0, 1), for samplers in the graph
   */
  constructor(artifacts, { random = Math.random } = {}) {
    const nodes = artifacts?.modelTopology?.node;
    if (!Array.isArray(nodes)) throw new Error("model.json holds no graph (modelTopology.node)");
    for (const node of nodes) this.#nodes.set(node.name, { ...node, input: (node.input ?? []).filter((i) => !i.startsWith("^")) });
    this.#constants = weights(artifacts);
    this.#random = random;
    this.inputs = entries(artifacts.signature?.inputs) ?? nodes.filter(({ op }) => op === "Placeholder").map(({ name, attr }) => {
      return described(name, { name, dtype: attr?.dtype?.type, tensorShape: attr?.shape?.shape });
    });
    const read = new Set(nodes.flatMap(({ input = [] }) => input.map((name) => parsed(name)[0])));
    this.outputs = entries(artifacts.signature?.outputs) ?? nodes.filter(({ name }) => !read.has(name)).map(({ name }) => described(name, { name }));
    for (const { source } of this.outputs) this.#plan([source]);
  }

  /**
   * One run.
   * @param {Record<string, {dtype: string, shape: number[], data: ArrayLike<number>}>} feeds by the inputs' names
   * @param {string[]} names outputs, or any node's ("n", "n:1")
   * @returns {Record<string, {dtype: string, shape: number[], data: Float32Array | Int32Array | Uint8Array}>}
   */
  run(feeds, names = this.outputs.map(({ name }) => name)) {
    const values = new Map(this.#constants);
    for (const { name, source } of this.inputs) if (feeds[name] !== undefined) values.set(parsed(source)[0], [feeds[name]]);
    const sources = names.map((name) => this.outputs.find((output) => output.name === name)?.source ?? name);
    for (const node of this.#plan(sources)) {
      if (values.has(node.name)) continue;
      if (DATA.has(node.op)) throw new Error(`the ${node.op === "Const" ? "constant" : "input"} '${node.name}' has no value`);
      const operands = node.input.map((reference) => valueOf(values, reference));
      try {
        const result = node.kernel({ ...node.attrs, random: this.#random }, ...operands);
        values.set(node.name, Array.isArray(result) ? result : [result]);
      } catch (error) {
        throw new Error(`node '${node.name}' (${node.op}): ${error.message}`);
      }
    }
    return Object.fromEntries(names.map((name, i) => [name, valueOf(values, sources[i])]));
  }

  /** The nodes that some tensors depend on, each after what it reads; an op that has no kernel is an error. */
  #plan(sources) {
    const key = JSON.stringify(sources);
    if (this.#plans.has(key)) return this.#plans.get(key);
    const [plan, state] = [[], new Map()];
    const stack = sources.map((source) => parsed(source)[0]);
    while (stack.length > 0) {
      const name = stack.at(-1);
      const node = this.#nodes.get(name);
      if (node === undefined) throw new Error(`the graph has no node '${name}'`);
      if (state.get(name) !== undefined) {
        stack.pop();
        if (state.get(name) === "open") plan.push(prepared(node));
        state.set(name, "done");
        continue;
      }
      state.set(name, "open");
      for (const reference of node.input) {
        const upstream = parsed(reference)[0];
        if (state.get(upstream) === "open") throw new Error(`node '${name}' depends on itself`);
        if (state.get(upstream) === undefined) stack.push(upstream);
      }
    }
    this.#plans.set(key, plan);
    return plan;
  }
}

function prepared(node) {
  const op = SPELLINGS[node.op] ?? node.op;
  if (!DATA.has(op) && !Object.hasOwn(KERNELS, op)) throw new Error(`node '${node.name}': no kernel for the op ${node.op}`);
  return { ...node, kernel: KERNELS[op], attrs: Object.fromEntries(Object.entries(node.attr ?? {}).map(([k, v]) => [k, attribute(v)])) };
}

/** "node:1" as the node's name and the number of its result. */
function parsed(reference) {
  const at = reference.lastIndexOf(":");
  return at < 0 ? [reference, 0] : [reference.slice(0, at), Number(reference.slice(at + 1))];
}

function valueOf(values, reference) {
  const [name, index] = parsed(reference);
  const value = values.get(name)?.[index];
  if (value === undefined) throw new Error(`no value for '${reference}'`);
  return value;
}

/** An attribute of a GraphDef in JSON. */
function attribute(value) {
  if (value.list !== undefined) return (value.list.i ?? value.list.s ?? []).map((item) => (value.list.s ? string(item) : Number(item)));
  if (value.type !== undefined) return DTYPES[value.type];
  if (value.i !== undefined) return Number(value.i);
  return value.s !== undefined ? string(value.s) : (value.f ?? value.b);
}

/** Bytes stand in JSON in base64, or as a list of numbers. */
const string = (value) => (Array.isArray(value) ? String.fromCharCode(...value) : atob(value));

/** What weights that are float32 may be stored as. */
const NARROW = { float16: Uint16Array, uint8: Uint8Array };

/** Weights as float32: halves by their bits (not every engine has a Float16Array), or steps of one length. */
function widened(data, { dtype, scale, min }) {
  return Float32Array.from(data, dtype === "uint8" ? (value) => value * scale + min : half);
}

/** A float16, of its bits. */
function half(bits) {
  const exponent = (bits >> 10) & 31;
  const digits = bits & 1023;
  const size = exponent === 0 ? digits * 2 ** -24
    : exponent === 31 ? (digits ? NaN : Infinity)
      : (1 + digits / 1024) * 2 ** (exponent - 15);
  return bits & 0x8000 ? -size : size;
}

/** Constants by their nodes' names. */
function weights({ weightsManifest = [], weightData }) {
  const found = new Map();
  let offset = 0;
  for (const { name, shape, dtype, quantization } of weightsManifest.flatMap((group) => group.weights)) {
    const kind = quantization?.dtype ?? dtype;
    const kinds = quantization === undefined ? ARRAYS : dtype === "float32" ? NARROW : {};
    if (!Object.hasOwn(kinds, kind)) {
      throw new Error(`the weights '${name}' are ${kind}; float32, int32 and bool are taken`);
    }
    const bytes = sizeOf(shape) * kinds[kind].BYTES_PER_ELEMENT;
    if (offset + bytes > weightData.byteLength) throw new Error("the weights are cut off");
    const data = new kinds[kind](weightData.slice(offset, offset + bytes));
    found.set(name, [{ dtype, shape, data: quantization === undefined ? data : widened(data, quantization) }]);
    offset += bytes;
  }
  return found;
}

/** A signature's entries; undefined where it has none. */
function entries(part) {
  const all = Object.entries(part ?? {});
  return all.length > 0 ? all.map(([name, info]) => described(name, info)) : undefined;
}

function described(name, { name: source = name, dtype, tensorShape }) {
  const dims = tensorShape === undefined || tensorShape.unknownRank ? null : (tensorShape.dim ?? []);
  return { name, source, dtype: DTYPES[dtype] ?? null, shape: dims?.map(({ size }) => (Number(size) >= 0 ? Number(size) : null)) ?? null };
}
