"""The words of C# 7.3 for the loop language."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.converters.formats.programs.weights import Kept
from export_model.converters.graph.blocks import LANES, TERMS, Packed
from export_model.converters.graph.language import Language, bare, lines_of
from export_model.converters.graph.ops.loops.base import Applied
from export_model.converters.graph.types import BOOL, FLOAT32, INT32, INT64

#: What C# calls a dtype.
CS_TYPES = {"float32": "float", "int32": "int", "int64": "long", "bool": "bool", "int8": "sbyte", "float16": "ushort"}
_SAME = {"exp": "Exp", "log": "Log", "sqrt": "Sqrt", "sin": "Sin", "cos": "Cos", "tan": "Tan", "tanh": "Tanh",
         "floor": "Floor", "ceil": "Ceiling", "rint": "Round"}  # fmt: skip
#: Functions that a class brings along: of floats, and of whole numbers. .NET Standard 2.0 has Math in double alone.
_HELPERS = {
    "_Expm1": ("double x = a; return (float)(global::System.Math.Abs(x) < 1e-5 ? x + x * x / 2 "
              ": global::System.Math.Exp(x) - 1);", ""),
    "_Log1p": ("double x = a; return (float)(global::System.Math.Abs(x) < 1e-5 ? x - x * x / 2 "
              ": global::System.Math.Log(1 + x));", ""),
    "_Erf": ("if (!(a > -4 && a < 4)) return a > 0 ? 1 : a < 0 ? -1 : a; double term = a, sum = a; "
            "for (int n = 1; n < 70; n++) { term *= -(double)a * a / n; sum += term / (2 * n + 1); } "
            "return (float)(sum * 1.1283791670955126);", ""),
    "_Pow": ("return (float)global::System.Math.Pow(a, b);", ""),
    "_Max": ("return a < b || float.IsNaN(b) ? b : a;", "return a < b ? b : a;"),
    "_Min": ("return b < a || float.IsNaN(b) ? b : a;", "return b < a ? b : a;"),
    "_Abs": ("return global::System.Math.Abs(a);", "return a < 0 ? -a : a;"),
    "_Mod": ("float r = a % b; return r != 0 && (r < 0) != (b < 0) ? r + b : r;",) * 2,
    "_IntDiv": ("return (float)global::System.Math.Floor(a / b);",
               "return a / b - (a % b != 0 && (a % b < 0) != (b < 0) ? 1 : 0);"),
    "_Within": ("", 'if (a >= 0 && a < b) return a; throw new global::System.IndexOutOfRangeException('
               '"the index " + a + " lies outside of a table of " + b);'),
}  # fmt: skip
_CALLED = {"expm1": "_Expm1", "log1p": "_Log1p", "erf": "_Erf", "pow": "_Pow", "max": "_Max", "min": "_Min",
           "abs": "_Abs", "mod": "_Mod", "intdiv": "_IntDiv", "within": "_Within"}  # fmt: skip


#: Functions of a number's bits: without ``unsafe``, and older than BitConverter's.
_RAW = {
    "bits": ("_Bits", "static int _Bits(float a) { return new _Word { number = a }.bits; }"),
    "of_bits": ("_OfBits", "static float _OfBits(int a) { return new _Word { bits = a }.number; }"),
}
_TAKE = """static T[] _Take<T>(byte[] bytes, int offset, int count, int size)
{
    var array = new T[count];
    global::System.Buffer.BlockCopy(bytes, offset, array, 0, count * size);
    return array;
}"""
_WIDEN = """static float[] _Widen(sbyte[] steps, float[] length, int inner) // a length for each channel
{
    var wide = new float[steps.Length];
    for (int i = 0; i < wide.Length; i++) wide[i] = steps[i] * length[i / inner % length.Length];
    return wide;
}"""
_HALF = """static float[] _Half(ushort[] bits) // numbers in 16 bits
{
    var wide = new float[bits.Length];
    for (int i = 0; i < wide.Length; i++) {
        int exponent = bits[i] >> 10 & 31;
        long size = (bits[i] & 1023) + (exponent == 0 ? 0 : 1024);
        float x = (float)(size << (exponent == 0 ? 1 : exponent)) * 2.98023224e-08f;
        wide[i] = (bits[i] & 0x8000) != 0 ? -x : x;
    }
    return wide;
}"""
_WORD = """// The bits of a number.
[global::System.Runtime.InteropServices.StructLayout(global::System.Runtime.InteropServices.LayoutKind.Explicit)]
struct _Word
{
    [global::System.Runtime.InteropServices.FieldOffset(0)] public float number;
    [global::System.Runtime.InteropServices.FieldOffset(0)] public int bits;
}"""


def _block_text() -> str:
    """The structure of a block, and how an array is cut into them."""
    names = [f"a{i}" for i in range(TERMS * LANES)]
    rows = [names[i : i + LANES] for i in range(0, len(names), LANES)]
    places = ["at", "at + lane", *(f"at + {q} * lane" for q in range(2, LANES))]
    filled = [" ".join(f"{n} = w[{place}];" for n, place in zip(row, places, strict=True)) for row in rows]
    filled = [f"if (terms < {n}) return;\n        {text}" for n, text in enumerate(filled, 1)]
    return (
        f"struct _Block // {LANES} weights for each of {TERMS} numbers: one look at an array's bound for all\n{{\n"
        + "".join(f"    public float {', '.join(row)};\n" for row in rows)
        + "\n    public _Block(float[] w, int at, int terms, int term, int lane) : this()\n    {\n        "
        + "\n        at += term;\n        ".join(filled)
        + "\n    }\n}"
    )


_PACK = """static _Block[] _Pack(float[] w, int start, int[] lengths, int[] steps, int terms, int term, int lane)
{
    int count = 1, last = lengths[lengths.Length - 1];
    foreach (int length in lengths) count *= length;
    var packed = new _Block[count];
    for (int i = 0; i < count; i++) {
        int at = start, rest = i;
        for (int axis = lengths.Length - 1; axis >= 0; axis--) {
            at += rest % lengths[axis] * steps[axis];
            rest /= lengths[axis];
        }
        packed[i] = new _Block(w, at, terms - i % last * $TERMS, term, lane);
    }
    return packed;
}""".replace("$TERMS", str(TERMS))


class CSharp(Language):
    """C# 7.3."""

    terms = 8
    blocks = True

    def literal(self, value: float, dtype: np.dtype) -> str:
        """A number as C# reads it, to the last bit."""
        if dtype == BOOL:
            return "true" if value else "false"
        if dtype == FLOAT32:
            if value != value or value in (np.inf, -np.inf):
                word = "NaN" if value != value else "PositiveInfinity" if value > 0 else "NegativeInfinity"
                return f"float.{word}"
            text = f"{float(np.float32(value)):.9g}f"
            return f"({text})" if text[0] == "-" else text
        if value == np.iinfo(dtype).min:
            return f"{CS_TYPES[dtype.name]}.MinValue"
        text = f"{int(value)}{'L' if dtype == INT64 else ''}"
        return f"({text})" if value < 0 else text

    def declaration(self, dtype: np.dtype, name: str, value: str, *, constant: bool) -> str:
        """A local variable."""
        return f"{CS_TYPES[dtype.name]} {name} = {value};"

    def cast(self, text: str, source: np.dtype, target: np.dtype) -> str:
        """A number of another dtype; a float outside of an integer's range, which C# leaves open, is the least one."""
        kind = CS_TYPES[target.name]
        if source == target:
            return text
        if source == BOOL:
            return f"({text} ? {self.literal(1, target)} : {self.literal(0, target)})"
        if source != FLOAT32 or target == FLOAT32:
            return f"(({kind}){text})"
        name, limit = ("_WholeInt", "2147483648f") if target == INT32 else ("_WholeLong", "9223372036854775808f")
        inside = f"a >= -{limit} && a < {limit}"
        self.helpers[name] = f"static {kind} {name}(float a) {{ return {inside} ? ({kind})a : {kind}.MinValue; }}"
        return f"{name}({bare(text)})"

    def helper(self, function: str, operands: Sequence[str], dtype: np.dtype) -> str:
        """A call of a function that the class brings along."""
        kind = CS_TYPES[dtype.name]
        if function in _RAW:
            name, said = _RAW[function]
            self.helpers |= {"Word": _WORD, name: said}
            return f"{name}({bare(operands[0])})"
        takes = ", ".join(f"{kind} {a}" for a in "ab"[: len(operands)])
        given = "ab"[: len(operands)]
        known = _SAME.get(function)
        name = f"_{known}" if known else _CALLED[function]
        real = f"return ({kind})global::System.Math.{known}({', '.join(given)});"
        if function in ("floor", "ceil", "rint") and dtype != FLOAT32:
            said = "return a;"
        else:
            said = _HELPERS.get(name, ("", ""))[dtype != FLOAT32] or real
        said = said.replace("float r", f"{kind} r")
        self.helpers[f"{name} {kind}"] = f"static {kind} {name}({takes}) {{ {said} }}"
        return f"{name}({', '.join(bare(o) for o in operands)})"

    def round_to(self, text: str, x: Applied) -> str:
        """What an operator gives; a cast rounds it where a processor, or a virtual machine, has more digits."""
        return f"(float){text}" if self.own and x.dtype == FLOAT32 else text

    def own_name(self, function: str) -> str:
        """As in Math, with a capital."""
        return f"_{function.capitalize()}"

    def block(self, name: str, packed: str, at: str) -> str:
        """A reference to the next block."""
        return f"ref _Block {name} = ref {packed}[{at}++];"

    def in_block(self, name: str, number: int) -> str:
        """A member of a block."""
        return f"{name}.a{number}"

    def blocks_of(self, packed: Packed, array: str) -> str:
        """The blocks of an array."""
        self.helpers["_Block"], self.helpers["_Pack"] = _block_text(), _PACK
        lengths, steps = (", ".join(map(str, n)) for n in (packed.lengths, packed.steps))
        apart = f"{packed.terms}, {packed.term}, {packed.lane}"
        return f"_Pack({array}, {packed.start}, new int[] {{ {lengths} }}, new int[] {{ {steps} }}, {apart})"

    def draw(self) -> str:
        """The next number of an agent's stream."""
        return "_Uniform()"

    def constant(self, kept: Kept) -> str:
        """The array of a constant, widened where it is kept in fewer bytes; from ``bytes`` where it is in a file."""
        parts = [kept.narrow, *([] if kept.step is None else [kept.step])]
        kinds = [CS_TYPES[p.dtype.name] for p in parts]
        if kept.offsets:
            self.helpers["_Take"] = _TAKE
            arrays = [
                f"_Take<{kind}>(bytes, {offset}, {p.size}, {p.dtype.itemsize})"
                for kind, p, offset in zip(kinds, parts, kept.offsets, strict=True)
            ]
        else:
            pairs = zip(kinds, parts, strict=True)
            arrays = [f"new {kind}[] {{\n    {lines_of(self.elements(p))},\n}}" for kind, p in pairs]
        if kept.step is not None:
            self.helpers["_Widen"] = _WIDEN
            return f"_Widen({', '.join(arrays)}, {kept.inner})"
        if kept.narrow is not kept.place:
            self.helpers["_Half"] = _HALF
            return f"_Half({arrays[0]})"
        return arrays[0]
