/**
 * Tensors: `{ dtype, shape, data }` with a flat typed array in row-major order, and what all kernels need of them.
 *
 * There are float32, int32 and bool, as in a TensorFlow.js model. A number is computed as a double and stored in a
 * Float32Array: that rounds once, which for + − × ÷ and √ of float32 numbers is what IEEE asks of float32 itself.
 */

export const ARRAYS = { float32: Float32Array, int32: Int32Array, bool: Uint8Array };

/** More elements than any policy's tensor has: what a damaged file asks for is refused before it is allocated. */
const MOST_ELEMENTS = 2 ** 28;

export const sizeOf = (shape) => shape.reduce((product, n) => product * n, 1);

/** The number of elements of a shape that a tensor may have. */
export function countOf(shape) {
  const count = sizeOf(shape);
  if (!shape.every((n) => Number.isInteger(n) && n >= 0) || count > MOST_ELEMENTS) throw new Error(`no tensor has the shape [${shape}]`);
  return count;
}

/** A tensor of zeros. */
export function zeros(dtype, shape) {
  const count = countOf(shape);
  if (!Object.hasOwn(ARRAYS, dtype)) throw new Error(`there are no ${dtype} tensors here`);
  return { dtype, shape, data: new ARRAYS[dtype](count) };
}

/** The same elements under another shape; one -1 stands for what is left. */
export function reshaped(x, shape) {
  const known = sizeOf(shape.filter((n) => n !== -1));
  const whole = shape.map((n) => (n === -1 ? x.data.length / known : n));
  if (sizeOf(whole) !== x.data.length) throw new Error(`[${x.shape}] does not reshape to [${shape}]`);
  return { ...x, shape: whole };
}

/** How far apart the elements of each axis lie. */
export function stridesOf(shape) {
  const strides = new Array(shape.length).fill(1);
  for (let axis = shape.length - 2; axis >= 0; axis--) strides[axis] = strides[axis + 1] * shape[axis + 1];
  return strides;
}

export function axisOf(axis, rank) {
  if (!(axis >= -rank && axis < rank)) throw new Error(`a tensor of rank ${rank} has no axis ${axis}`);
  return axis < 0 ? axis + rank : axis;
}

/** The shape that operands have together, by numpy's rules. */
export function broadcast(...shapes) {
  const rank = Math.max(...shapes.map((shape) => shape.length));
  return Array.from({ length: rank }, (_, i) => {
    const lengths = shapes.map((shape) => shape[i - rank + shape.length] ?? 1).filter((n) => n !== 1);
    if (lengths.some((n) => n !== lengths[0])) throw new Error(`[${shapes.join("] and [")}] do not fit together`);
    return lengths[0] ?? 1;
  });
}

/** Where each element of a result of `shape` is found in `x`: the offsets to read. `x` is broadcast. */
export function broadcastOffsets(x, shape) {
  const own = stridesOf(x.shape);
  const lead = shape.length - x.shape.length;
  return offsets(shape, shape.map((_, i) => (i < lead || x.shape[i - lead] === 1 ? 0 : own[i - lead])));
}

/** The offsets that walking along `shape` with these strides gives, from `start`. */
export function offsets(shape, strides, start = 0) {
  countOf(shape);
  let found = Int32Array.of(start);
  shape.forEach((length, axis) => {
    const next = new Int32Array(found.length * length);
    for (let i = 0, k = 0; i < found.length; i++) for (let j = 0; j < length; j++) next[k++] = found[i] + j * strides[axis];
    found = next;
  });
  return found;
}

/** The elements of `x` at `places`, as a tensor. */
export function picked(x, shape, places) {
  const result = zeros(x.dtype, shape);
  for (let i = 0; i < places.length; i++) result.data[i] = x.data[places[i]];
  return result;
}

/** `work(...numbers)` for each element of operands that are broadcast. */
export function each(dtype, work, ...operands) {
  const shape = broadcast(...operands.map((x) => x.shape));
  const result = zeros(dtype, shape);
  const out = result.data;
  const given = operands.map(({ data }) => data);
  const at = operands.map((x) => (x.data.length === out.length ? null : broadcastOffsets(x, shape)));
  if (given.length === 1) for (let i = 0; i < out.length; i++) out[i] = work(given[0][i]);
  else if (given.length === 2) {
    const [[a, b], [p, q]] = [given, at];
    for (let i = 0; i < out.length; i++) out[i] = work(a[p === null ? i : p[i]], b[q === null ? i : q[i]]);
  } else for (let i = 0; i < out.length; i++) out[i] = work(...given.map((data, n) => data[at[n] === null ? i : at[n][i]]));
  return result;
}

/** A vector's or scalar's numbers. */
export const numbers = ({ data }) => Array.from(data);

export const vector = (values) => ({ dtype: "int32", shape: [values.length], data: Int32Array.from(values) });
export const scalar = (value, dtype = "int32") => ({ dtype, shape: [], data: ARRAYS[dtype].of(value) });
