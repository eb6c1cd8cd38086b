"""The words of JavaScript for the loop language: numbers are rounded to float32 as C rounds them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.converters.formats.programs.weights import Kept
from export_model.converters.graph.language import Language, bare, lines_of
from export_model.converters.graph.ops.loops.base import Applied, Element
from export_model.converters.graph.ops.loops.own_math import OWN
from export_model.converters.graph.program import every
from export_model.converters.graph.types import BOOL, FLOAT32, INT32, INT64

#: The arrays of each dtype. int64 is held in doubles, which have every whole number up to 2 to the 53.
JS_ARRAYS = {
    "float32": "Float32Array",
    "int32": "Int32Array",
    "int64": "Float64Array",
    "bool": "Uint8Array",
    "int8": "Int8Array",
}
JS_ARRAYS["float16"] = "Uint16Array"
_SAME = ("exp", "expm1", "log", "log1p", "sqrt", "sin", "cos", "tan", "tanh", "floor", "ceil")
_PLAIN = {"max": "Math.max", "min": "Math.min", "abs": "Math.abs"}
#: Functions of a number's bits.
_RAW = {
    "bits": "function _bits(a) {\n    _word[0] = a;\n    return _wordBits[0];\n}",
    "of_bits": "function _of_bits(a) {\n    _wordBits[0] = a;\n    return _word[0];\n}",
}
_WORD = "const _word = new Float32Array(1), _wordBits = new Int32Array(_word.buffer);"
#: Functions that a module brings along.
_HELPERS = {
    "mod": "function _mod(a, b) { const r = a % b; return r !== 0 && r < 0 !== b < 0 ? r + b : r; }",
    "intdiv": "function _intdiv(a, b) { return Math.floor(a / b); }",
    "rint": "function _rint(a) { return Math.abs(a % 1) === 0.5 ? 2 * Math.round(a / 2) : Math.round(a); }",
    "within": (
        "function _within(a, count) {\n    if (a >= 0 && a < count) return a;\n"
        "    throw new RangeError(`the index ${a} lies outside of a table of ${count}`);\n}"
    ),
    "half": (
        "function _half(a) { // the number in 16 bits\n    const exponent = a >> 10 & 31;\n"
        "    const size = ((a & 1023) + (exponent ? 1024 : 0)) * 2 ** ((exponent || 1) - 25);\n"
        "    return a & 0x8000 ? -size : size;\n}"
    ),
    "widen": (
        "function _widen(steps, length, inner) { // a length for each channel\n"
        "    return Float32Array.from(steps, (n, i) => n * length[Math.floor(i / inner) % length.length]);\n}"
    ),
    "whole": (
        "function _whole(a, limit) {\n    return a >= -limit && a < limit ? Math.trunc(a) : -limit;\n}"
    ),
    "erf": (
        "function _erf(a) { // by its power series\n    if (!(Math.abs(a) < 4)) return a > 0 ? 1 : a < 0 ? -1 : a;\n"
        "    let term = a, sum = a;\n    for (let n = 1; n < 70; n++) {\n        term *= -a * a / n;\n"
        "        sum += term / (2 * n + 1);\n    }\n    return sum * 1.1283791670955126;\n}"
    ),
}  # fmt: skip


class JavaScript(Language):
    """An ES module."""

    element, counter, whole = "{}", "let", "{} | 0"
    functions = (
        {name: f"Math.{name}({{0}})" for name in _SAME}
        | {name: f"_{name}({{0}})" for name in ("erf", "rint")}
        | {"pow": "Math.pow({0}, {1})"}
    )

    def literal(self, value: float, dtype: np.dtype) -> str:
        """A number as JavaScript reads it, to the last bit."""
        if dtype == BOOL:
            return "true" if value else "false"
        if dtype != FLOAT32:
            return f"({int(value)})" if value < 0 else str(int(value))
        if value != value:
            return "NaN"
        if value in (np.inf, -np.inf):
            return "Infinity" if value > 0 else "(-Infinity)"
        text = repr(float(np.float32(value))).removesuffix(".0")
        return f"({text})" if text[0] == "-" else text

    def declaration(self, dtype: np.dtype, name: str, value: str, *, constant: bool) -> str:
        """A local variable."""
        return f"{'const' if constant else 'let'} {name} = {value};"

    def cast(self, text: str, source: np.dtype, target: np.dtype) -> str:
        """A number of another dtype; a float outside of an integer's range is the least one."""
        if source == target:
            return text
        if source == BOOL:
            return f"(+{text})"
        if target == FLOAT32:
            return f"fround({bare(text)})"
        if source == FLOAT32:
            self.helpers["whole"] = _HELPERS["whole"]
            return f"_whole({bare(text)}, {2**31 if target == INT32 else 2**63})"
        return f"({text} | 0)" if target == INT32 else text

    def helper(self, function: str, operands: Sequence[str], dtype: np.dtype) -> str:
        """A call of a function that the module brings along, or that ``Math`` has."""
        if function in _RAW:
            self.helpers |= {"word": _WORD, function: _RAW[function]}
        elif function not in _PLAIN:
            self.helpers[function] = _HELPERS[function]
        text = f"{_PLAIN.get(function, f'_{function}')}({', '.join(bare(o) for o in operands)})"
        return f"fround({text})" if function in ("mod", "intdiv") and dtype == FLOAT32 else text

    def own_name(self, function: str) -> str:
        """As in Math; no member is called so."""
        return f"_{function}"

    def definition(self, name: str, takes: Sequence[str], lines: Sequence[str], result: str) -> str:
        """A function."""
        return "\n".join([f"function {name}({', '.join(takes)}) {{", *lines, f"    return {result};\n}}"])

    def draw(self) -> str:
        """The next number of an agent's stream."""
        return "this._uniform()"

    def round_to(self, text: str, x: Applied) -> str:
        """A float32, by ``Math.fround``."""
        return f"fround({bare(text)})" if x.dtype == FLOAT32 else text

    def applied(self, x: Applied, operands: Sequence[str]) -> str:
        """A function of operands; sums of int32 wrap as C's do, indices need not."""
        for name in ("erf", "rint"):
            if x.function == name and not (self.own and name in OWN):
                self.helpers[name] = _HELPERS[name]
        if x.function == "equal":
            return f"({operands[0]} {'==' if x.operands[0].dtype == BOOL else '==='} {operands[1]})"
        if x.dtype in (INT32, INT64) and x.function == "div":
            return f"Math.trunc({operands[0]} / {operands[1]})"
        if x.dtype == INT32 and any(isinstance(e, Element) for e in every(x)):
            if x.function == "mul":
                return f"Math.imul({operands[0]}, {operands[1]})"
            if x.function in ("add", "sub"):
                return f"({operands[0]} {'+' if x.function == 'add' else '-'} {operands[1]} | 0)"
        return super().applied(x, operands)

    def constant(self, kept: Kept) -> str:
        """The array of a constant, widened where it is kept in fewer bytes; from ``bytes`` where it is in a file."""
        parts = [kept.narrow, *([] if kept.step is None else [kept.step])]
        if kept.offsets:
            pairs = zip(parts, kept.offsets, strict=True)
            arrays = [f"new {JS_ARRAYS[p.dtype.name]}(bytes.buffer, {offset}, {p.size})" for p, offset in pairs]
        else:
            arrays = [f"new {JS_ARRAYS[p.dtype.name]}([\n    {lines_of(self.elements(p))},\n])" for p in parts]
        if kept.step is not None:
            self.helpers["widen"] = _HELPERS["widen"]
            return f"_widen({', '.join(arrays)}, {kept.inner})"
        if kept.narrow is not kept.place:
            self.helpers["half"] = _HELPERS["half"]
            return f"Float32Array.from({arrays[0]}, _half)"
        return arrays[0]
