/** Shapes, joining and cutting, slices, gathers, arrays made by rule. */

import {
  axisOf, broadcast, broadcastOffsets, countOf, each, numbers, offsets, picked, reshaped, scalar, sizeOf, stridesOf, vector, zeros,
} from "./tensors.mjs";

const same = (_, x) => x;

function squeeze({ squeeze_dims = [] }, x) {
  const axes = squeeze_dims.map((axis) => axisOf(axis, x.shape.length));
  return reshaped(x, x.shape.filter((n, i) => (axes.length > 0 ? !axes.includes(i) : n !== 1)));
}

function expandDims(_, x, axis) {
  const shape = [...x.shape];
  shape.splice(axisOf(axis.data[0], shape.length + 1), 0, 1);
  return reshaped(x, shape);
}

function transpose(_, x, order) {
  const strides = stridesOf(x.shape);
  const shape = numbers(order).map((axis) => x.shape[axis]);
  return picked(x, shape, offsets(shape, numbers(order).map((axis) => strides[axis])));
}

// ---- joining and cutting ---------------------------------------------------------------------------------------------

function concat(parts, axis) {
  const at = axisOf(axis, parts[0].shape.length);
  const shape = parts[0].shape.map((n, i) => (i === at ? parts.reduce((sum, part) => sum + part.shape[at], 0) : n));
  const result = zeros(parts[0].dtype, shape);
  const outer = sizeOf(shape.slice(0, at));
  let place = 0;
  for (let row = 0; row < outer; row++) {
    for (const { data } of parts) {
      const width = data.length / outer;
      result.data.set(data.subarray(row * width, (row + 1) * width), place);
      place += width;
    }
  }
  return result;
}

const pack = ({ axis = 0 }, ...parts) => concat(parts.map((part) => expandDims({}, part, scalar(axis))), axis);

/** Pieces of these lengths along an axis; -1 is what is left. */
function pieces(x, axis, lengths) {
  const at = axisOf(axis, x.shape.length);
  const rest = x.shape[at] - lengths.filter((n) => n !== -1).reduce((a, b) => a + b, 0);
  let begin = 0;
  return lengths.map((length) => {
    const piece = cut(x, x.shape.map((n, i) => (i === at ? [begin, length === -1 ? rest : length, 1] : [0, n, 1])));
    begin += piece.shape[at];
    return piece;
  });
}

function unpack({ axis = 0 }, x) {
  const at = axisOf(axis, x.shape.length);
  const without = x.shape.filter((_, i) => i !== at);
  return pieces(x, at, new Array(x.shape[at]).fill(1)).map((piece) => reshaped(piece, without));
}

/** `[begin, length, stride]` for each axis. */
function cut(x, parts) {
  const strides = stridesOf(x.shape);
  for (const [i, [begin, length, stride]] of parts.entries()) {
    const last = begin + (length - 1) * stride;
    if (length > 0 && !(Math.min(begin, last) >= 0 && Math.max(begin, last) < x.shape[i])) throw new Error(`a slice leaves axis ${i}`);
  }
  const shape = parts.map(([, length]) => Math.max(length, 0));
  const start = parts.reduce((sum, [begin], i) => sum + begin * strides[i], 0);
  return picked(x, shape, offsets(shape, parts.map(([, , stride], i) => stride * strides[i]), start));
}

function slice(_, x, begin, size) {
  return cut(x, x.shape.map((n, i) => [begin.data[i], size.data[i] === -1 ? n - begin.data[i] : size.data[i], 1]));
}

/** `tf.strided_slice` with its five masks; a bound beyond an end is that end. */
function stridedSlice(masks, x, begin, end, strides) {
  const has = (mask, i) => ((masks[`${mask}_mask`] ?? 0) >> i) & 1;
  const entries = numbers(begin).map((_, i) => i);
  const named = entries.filter((i) => !has("ellipsis", i) && !has("new_axis", i)).length;
  const [parts, shape] = [[], []];
  const whole = () => {
    const n = x.shape[parts.length];
    parts.push([0, n, 1]);
    shape.push(n);
  };
  for (const i of entries) {
    const n = x.shape[parts.length];
    if (has("ellipsis", i)) for (let k = named; k < x.shape.length; k++) whole();
    else if (has("new_axis", i)) shape.push(1);
    else if (has("shrink_axis", i)) parts.push([axisOf(begin.data[i], n), 1, 1]);
    else {
      const stride = strides.data[i];
      const [low, high] = stride > 0 ? [0, n] : [-1, n - 1];
      const bound = (value) => Math.min(Math.max(value < 0 ? value + n : value, low), high);
      const first = has("begin", i) ? (stride > 0 ? low : high) : bound(begin.data[i]);
      const last = has("end", i) ? (stride > 0 ? high : low) : bound(end.data[i]);
      const length = Math.max(Math.ceil((last - first) / stride), 0);
      parts.push([first, length, stride]);
      shape.push(length);
    }
  }
  while (parts.length < x.shape.length) whole();
  return reshaped(cut(x, parts), shape);
}

function gather(_, x, indices, axis = scalar(0)) {
  const at = axisOf(axis.data[0], x.shape.length);
  const [before, length, after] = [x.shape.slice(0, at), x.shape[at], x.shape.slice(at + 1)];
  const outside = indices.data.find((index) => !(index >= 0 && index < length));
  if (outside !== undefined) throw new Error(`index ${outside} is outside of 0 to ${length - 1}`);
  const width = sizeOf(after);
  const shape = [...before, ...indices.shape, ...after];
  const places = new Int32Array(countOf(shape));
  let place = 0;
  for (let row = 0; row < sizeOf(before); row++) {
    for (const index of indices.data) for (let k = 0; k < width; k++) places[place++] = (row * length + index) * width + k;
  }
  return picked(x, shape, places);
}

// ---- by rule ---------------------------------------------------------------------------------------------------------

function broadcastTo(_, x, shape) {
  const whole = broadcast(x.shape, numbers(shape));
  return picked(x, whole, broadcastOffsets(x, whole));
}

function tile(_, x, times) {
  countOf(x.shape.map((n, axis) => n * times.data[axis]));
  const repeated = (y, n, axis) => (n === 0 ? cut(y, y.shape.map((k, i) => [0, i === axis ? 0 : k, 1])) : concat(new Array(n).fill(y), axis));
  return numbers(times).reduce(repeated, x);
}

function range(_, start, limit, delta) {
  const [first, last, step] = [start, limit, delta].map(({ data }) => data[0]);
  const result = zeros(start.dtype, [Math.max(Math.ceil((last - first) / step), 0)]);
  for (let i = 0; i < result.data.length; i++) result.data[i] = first + i * step;
  return result;
}

function oneHot({ axis = -1 }, indices, depth, on, off) {
  const at = axisOf(axis, indices.shape.length + 1);
  const numbered = zeros("int32", [depth.data[0]]);
  numbered.data.forEach((_, i, data) => (data[i] = i));
  const classes = reshaped(numbered, [-1, ...indices.shape.slice(at).map(() => 1)]);
  const index = expandDims({}, indices, scalar(at));
  return each(on.dtype, (i, k) => (i === k ? on.data[0] : off.data[0]), index, classes);
}

/** A tensor of `otherwise` with `values` (or one value) at places [n] or [n, rank]. */
function sparseToDense(_, places, shape, values, otherwise) {
  const result = zeros(values.dtype, numbers(shape));
  result.data.fill(otherwise.data[0]);
  const strides = stridesOf(result.shape);
  for (let i = 0; i * strides.length < places.data.length; i++) {
    const index = places.data.subarray(i * strides.length, (i + 1) * strides.length);
    const outside = index.findIndex((n, axis) => !(n >= 0 && n < result.shape[axis]));
    if (outside !== -1) throw new Error(`place ${index[outside]} is outside of 0 to ${result.shape[outside] - 1}`);
    const place = strides.reduce((sum, stride, axis) => sum + stride * index[axis], 0);
    result.data[place] = values.data[values.data.length === 1 ? 0 : i];
  }
  return result;
}

export const MOVING = {
  ...Object.fromEntries(["Identity", "StopGradient", "PreventGradient", "Snapshot", "CheckNumerics"].map((name) => [name, same])),
  Shape: (_, x) => vector(x.shape),
  Size: (_, x) => scalar(x.data.length),
  Rank: (_, x) => scalar(x.shape.length),
  Reshape: (_, x, shape) => reshaped(x, numbers(shape)),
  Squeeze: squeeze,
  ExpandDims: expandDims,
  Transpose: transpose,
  ConcatV2: (_, ...all) => concat(all.slice(0, -1), all.at(-1).data[0]),
  Pack: pack,
  Unpack: unpack,
  Split: ({ num_split: count }, axis, x) => pieces(x, axis.data[0], new Array(count).fill(x.shape.at(axis.data[0]) / count)),
  SplitV: (_, x, lengths, axis) => pieces(x, axis.data[0], numbers(lengths)),
  Slice: slice,
  StridedSlice: stridedSlice,
  Gather: gather,
  GatherV2: gather,
  Fill: (_, shape, value) => each(value.dtype, () => value.data[0], zeros(value.dtype, numbers(shape))),
  BroadcastTo: broadcastTo,
  Tile: tile,
  Range: range,
  OneHot: oneHot,
  SparseToDense: sparseToDense,
};
