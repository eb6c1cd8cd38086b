/** Matrix products, bias, reductions, softmax, argmax. Sums are kept in double and rounded once. */

import { activated, ELEMENTWISE } from "./elementwise.mjs";
import { axisOf, broadcast, broadcastOffsets, numbers, offsets, stridesOf, zeros } from "./tensors.mjs";

/** [rows, columns, how far rows lie apart, how far columns lie apart] of a tensor's last two axes. */
function matrix({ shape }, turned) {
  const [rows, columns] = shape.slice(-2);
  return turned ? [columns, rows, 1, columns] : [rows, columns, columns, 1];
}

function matmul({ transpose_a, transpose_b, adj_x, adj_y }, a, b) {
  if (a.shape.length < 2 || b.shape.length < 2) throw new Error("a matrix product takes matrices");
  const [rows, inner, aRow, aColumn] = matrix(a, transpose_a || adj_x);
  const [others, columns, bRow, bColumn] = matrix(b, transpose_b || adj_y);
  if (inner !== others) throw new Error(`the inner lengths ${inner} and ${others} differ`);
  const [leadA, leadB] = [a, b].map((x) => ({ shape: x.shape.slice(0, -2) }));
  const batch = broadcast(leadA.shape, leadB.shape);
  const result = zeros(a.dtype, [...batch, rows, columns]);
  const [startsA, startsB] = [leadA, leadB].map((lead) => broadcastOffsets(lead, batch));
  const sums = new Float64Array(columns);
  for (let n = 0; n < startsA.length; n++) {
    for (let i = 0; i < rows; i++) {
      sums.fill(0);
      for (let k = 0; k < inner; k++) {
        const factor = a.data[startsA[n] * rows * inner + i * aRow + k * aColumn];
        const start = startsB[n] * inner * columns + k * bRow;
        for (let j = 0; j < columns; j++) sums[j] += factor * b.data[start + j * bColumn];
      }
      result.data.set(sums, (n * rows + i) * columns);
    }
  }
  return result;
}

/** A product, its bias, and the activation that a fused op ends with. */
export function fused({ fused_ops }, product, bias) {
  return fused_ops.slice(1).reduce((x, name) => activated(name, x), ELEMENTWISE.Add({}, product, bias));
}

// ---- reductions -----------------------------------------------------------------------------------------------------

/** `x` as rows to be reduced: [the shape left, where each row begins, where its elements lie from there]. */
function rowsOver(x, axes, keep) {
  const strides = stridesOf(x.shape);
  const along = (wanted) => x.shape.map((_, i) => i).filter((i) => axes.includes(i) === wanted);
  const places = (chosen) => offsets(chosen.map((i) => x.shape[i]), chosen.map((i) => strides[i]));
  const shape = keep ? x.shape.map((n, i) => (axes.includes(i) ? 1 : n)) : along(false).map((i) => x.shape[i]);
  return [shape, places(along(false)), places(along(true))];
}

function reduction(start, work, finish = (value) => value) {
  return ({ keep_dims }, x, axes) => {
    const chosen = numbers(axes).map((axis) => axisOf(axis, x.shape.length));
    const [shape, begins, steps] = rowsOver(x, chosen, keep_dims);
    const result = zeros(x.dtype, shape);
    begins.forEach((begin, i) => {
      let value = start;
      for (const step of steps) value = work(value, x.data[begin + step]);
      result.data[i] = finish(value, steps.length);
    });
    return result;
  };
}

function best(better) {
  return ({ output_type = "int32" }, x, axis) => {
    const [shape, begins, steps] = rowsOver(x, [axisOf(axis.data[0], x.shape.length)], false);
    const result = zeros(output_type, shape);
    begins.forEach((begin, i) => {
      let found = 0;
      for (let k = 1; k < steps.length; k++) {
        const [old, value] = [x.data[begin + steps[found]], x.data[begin + steps[k]]];
        if (better(value, old) || (Number.isNaN(value) && !Number.isNaN(old))) found = k;
      }
      result.data[i] = found;
    });
    return result;
  };
}

/** `finish(x − the largest, the sum of exponentials)` along the last axis. */
function softmax(finish) {
  return (_, x) => {
    const result = zeros(x.dtype, x.shape);
    const width = x.shape.at(-1);
    for (let row = 0; row < x.data.length; row += width) {
      const values = Array.from(x.data.subarray(row, row + width));
      const most = values.reduce((a, b) => Math.max(a, b));
      const sum = values.reduce((total, value) => total + Math.exp(value - most), 0);
      values.forEach((value, i) => (result.data[row + i] = finish(value - most, sum)));
    }
    return result;
  };
}

export const LINEAR = {
  MatMul: matmul,
  BatchMatMul: matmul,
  _FusedMatMul: (attrs, a, b, bias) => fused(attrs, matmul(attrs, a, b), bias),
  BiasAdd: ELEMENTWISE.Add,
  Sum: reduction(0, (a, b) => a + b),
  Mean: reduction(0, (a, b) => a + b, (sum, count) => sum / count),
  Prod: reduction(1, (a, b) => a * b),
  Max: reduction(-Infinity, Math.max),
  Min: reduction(Infinity, Math.min),
  All: reduction(1, (a, b) => a && b),
  Any: reduction(0, (a, b) => a || b),
  ArgMax: best((a, b) => a > b),
  ArgMin: best((a, b) => a < b),
  Softmax: softmax((x, sum) => Math.exp(x) / sum),
  LogSoftmax: softmax((x, sum) => x - Math.log(sum)),
};
