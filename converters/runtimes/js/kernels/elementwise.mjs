/** Arithmetic, activations, comparisons, casts. Functions are computed in double and rounded once. */

import { each, reshaped, zeros } from "./tensors.mjs";

const SELU = { alpha: 1.6732632423543772, scale: 1.0507009873554805 };
const { abs, exp, expm1, floor, fround, imul, log1p, max, min, sign, sqrt, trunc } = Math;

/** To the nearest integer, halves to the even one. */
function rint(x) {
  const up = Math.round(x);
  return abs(x % 1) === 0.5 && up % 2 !== 0 ? up - 1 : up;
}

/** By its series, whose terms are all positive. */
function erf(x) {
  const size = abs(x);
  if (!(size < 6)) return sign(x); // a NaN is one here, too
  let [term, sum] = [size, size];
  for (let n = 1; term > sum * 1e-17; n++) sum += term *= (2 * x * x) / (2 * n + 1);
  return sign(x) * (2 / sqrt(Math.PI)) * exp(-x * x) * sum;
}

function sigmoid(x) {
  const small = exp(-abs(x));
  return (x >= 0 ? 1 : small) / (1 + small);
}

const FUNCTIONS = {
  Neg: (x) => -x,
  Abs: abs,
  Sign: sign,
  Reciprocal: (x) => 1 / x,
  Floor: floor,
  Ceil: Math.ceil,
  Round: rint,
  Exp: exp,
  Expm1: expm1,
  Log: Math.log,
  Log1p: log1p,
  Sqrt: sqrt,
  Rsqrt: (x) => 1 / sqrt(x),
  Sin: Math.sin,
  Cos: Math.cos,
  Tan: Math.tan,
  Erf: erf,
  Sigmoid: sigmoid,
  Tanh: Math.tanh,
  Relu: (x) => max(x, 0),
  Relu6: (x) => min(max(x, 0), 6),
  Elu: (x) => (x > 0 ? x : expm1(x)),
  Selu: (x) => SELU.scale * (x > 0 ? x : SELU.alpha * expm1(x)),
  Softplus: (x) => max(x, 0) + log1p(exp(-abs(x))),
  Softsign: (x) => x / (1 + abs(x)),
};

/** Towards the sign of the divisor, as Python's %. */
function floorMod(a, b) {
  const rest = a % b;
  if (rest === 0) return b < 0 ? -0 : 0;
  return rest < 0 !== b < 0 ? rest + b : rest;
}

/** As C and numpy have it: JavaScript's 1 ** NaN is NaN. */
const power = (a, b) => (a === 1 || (a === -1 && abs(b) === Infinity) ? 1 : a ** b);

/** [of floats, of integers] where they differ. */
const PAIRS = {
  Add: (a, b) => a + b,
  Sub: (a, b) => a - b,
  Mul: [(a, b) => a * b, imul],
  RealDiv: [(a, b) => a / b, (a, b) => trunc(a / b)],
  FloorDiv: [(a, b) => floor(fround(a / b)), (a, b) => floor(a / b)],
  FloorMod: floorMod,
  Maximum: max,
  Minimum: min,
  Pow: power,
  SquaredDifference: [(a, b) => fround(a - b) ** 2, (a, b) => imul(a - b, a - b)],
};

const TESTS = {
  Less: (a, b) => a < b,
  LessEqual: (a, b) => a <= b,
  Greater: (a, b) => a > b,
  GreaterEqual: (a, b) => a >= b,
  Equal: (a, b) => a === b,
  NotEqual: (a, b) => a !== b,
  LogicalAnd: (a, b) => a && b,
  LogicalOr: (a, b) => a || b,
};

const CASTS = { float32: (x) => x, int32: trunc, bool: (x) => x !== 0 };

const choose = (c, a, b) => (c ? a : b);

/** A condition of rank 1 chooses whole rows. */
function select(_, condition, a, b) {
  const rows = condition.shape.length === 1 && a.shape.length > 1;
  const chosen = rows ? reshaped(condition, [-1, ...a.shape.slice(1).map(() => 1)]) : condition;
  return each(a.dtype, choose, chosen, a, b);
}

/** What fused ops may end with. */
export const activated = (name, x) => ELEMENTWISE[name]({}, x);

const unary = Object.entries(FUNCTIONS).map(([name, work]) => [name, (_, x) => each(x.dtype, work, x)]);
const pairs = Object.entries(PAIRS).map(([name, work]) => {
  const [floats, integers] = Array.isArray(work) ? work : [work, work];
  return [name, (_, a, b) => each(a.dtype, a.dtype === "float32" ? floats : integers, a, b)];
});
const tests = Object.entries(TESTS).map(([name, work]) => [name, (_, a, b) => each("bool", work, a, b)]);

export const ELEMENTWISE = {
  ...Object.fromEntries([...unary, ...pairs, ...tests]),
  Square: (_, x) => ELEMENTWISE.Mul({}, x, x),
  LogicalNot: (_, x) => each("bool", (v) => !v, x),
  LeakyRelu: ({ alpha = 0.2 }, x) => each(x.dtype, (v) => (v > 0 ? v : v * fround(alpha)), x),
  Cast: ({ DstT }, x) => each(DstT, CASTS[DstT], x),
  ZerosLike: (_, x) => zeros(x.dtype, x.shape),
  OnesLike: (_, x) => each(x.dtype, () => 1, x),
  ClipByValue: (_, x, low, high) => each(x.dtype, (v, l, h) => max(min(v, h), l), x, low, high),
  AddN: (_, ...xs) => xs.reduce((a, b) => ELEMENTWISE.Add({}, a, b)),
  Select: select,
  SelectV2: (_, c, a, b) => each(a.dtype, choose, c, a, b),
};
