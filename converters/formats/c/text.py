"""The words of C99 for the loop language."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.converters.graph.language import Language, bare, lines_of
from export_model.converters.graph.program import Place
from export_model.converters.graph.types import FLOAT32, INT64

#: What C calls a dtype; a truth is an int, as C's comparisons are.
C_TYPES = {
    "float32": "float",
    "int32": "int32_t",
    "int64": "int64_t",
    "bool": "int32_t",
    "int8": "int8_t",
    "float16": "uint16_t",
}
_SAME = ("exp", "expm1", "log", "log1p", "sqrt", "sin", "cos", "tan", "tanh", "erf", "floor", "ceil", "rint")
#: Functions that a program brings along: what they are for floats, and for whole numbers.
_HELPERS = {
    "max": ("a < b || b != b ? b : a", "a < b ? b : a"),
    "min": ("b < a || b != b ? b : a", "b < a ? b : a"),
    "abs": ("fabsf(a)", "a < 0 ? -a : a"),
    "mod": ("fmodf(a, b) + ((fmodf(a, b) != 0.0f && (fmodf(a, b) < 0.0f) != (b < 0.0f)) ? b : 0.0f)",
            "a % b + ((a % b != 0 && (a % b < 0) != (b < 0)) ? b : 0)"),
    "within": ("", "0 <= a && a < b ? a : (*outside = 1, 0)"),
    "intdiv": ("floorf(a / b)", "a / b - ((a % b != 0 && (a % b < 0) != (b < 0)) ? 1 : 0)"),
}  # fmt: skip
#: Functions of a number's bits: what they do, and what they take.
_RAW = {
    "bits": ("int32_t b; memcpy(&b, &a, sizeof b); return b;", "float"),
    "of_bits": ("float b; memcpy(&b, &a, sizeof b); return b;", "int32_t"),
}
#: The number in 16 bits: sign, 5 bits of exponent, 10 of fraction. One below the least exponent is a whole multiple.
_HALF = """static float $P_half(uint16_t a)
{
    const int32_t rest = a & 0x7FFF, bits = rest * 8192 + 0x38000000;
    float x;
    memcpy(&x, &bits, sizeof x);
    x = rest < 1024 ? (float)rest * 5.9604644775390625e-8f : x;
    return (a & 0x8000) != 0 ? -x : x;
}"""
_SUFFIX = {"float": "f", "int32_t": "i", "int64_t": "l"}


class C(Language):
    """C99; ``prefix`` begins every name of file scope."""

    rows = True
    fast = frozenset(("exp", "expm1", "tanh"))
    inline, whole = "inline ", "(int32_t){}"
    functions = {name: f"{name}f({{0}})" for name in _SAME} | {"pow": "powf({0}, {1})"}

    def __init__(self, prefix: str, own: bool = False, loads: bool = False) -> None:
        super().__init__(own)
        self.prefix = prefix
        if loads:  # gcc -O2 makes no vectors where a row might overlap with weights that a pointer leads to
            self.apart = f"{prefix.upper()}_APART"

    def literal(self, value: float, dtype: np.dtype) -> str:
        """A number as C reads it, to the last bit."""
        if dtype == FLOAT32:
            if value != value or value in (np.inf, -np.inf):
                return "NAN" if value != value else "INFINITY" if value > 0 else "(-INFINITY)"
            text = f"{float(np.float32(value)):.9g}"
            text = f"{text if any(c in text for c in '.e') else text + '.0'}f"
            return text if value >= 0 and text[0] != "-" else f"({text})"
        whole = int(value)
        if dtype == INT64:
            return f"(-INT64_C({-whole - 1}) - 1)" if whole < 0 else f"INT64_C({whole})"
        return f"(-{-whole - 1} - 1)" if whole < -(2**31) + 1 else f"({whole})" if whole < 0 else str(whole)

    def declaration(self, dtype: np.dtype, name: str, value: str, *, constant: bool) -> str:
        """A local variable."""
        return f"{'const ' if constant else ''}{C_TYPES[dtype.name]} {name} = {value};"

    def cast(self, text: str, source: np.dtype, target: np.dtype) -> str:
        """A number of another dtype; a float outside of an integer's range, which C leaves open, is the least one."""
        kind = C_TYPES[target.name]
        if source == np.float16:
            self.helpers[f"{self.prefix}_half"] = _HALF.replace("$P", self.prefix)
            return f"{self.prefix}_half({bare(text)})"
        if source != FLOAT32 or target == FLOAT32:
            return f"({kind}){text}"
        bits = "63" if target == INT64 else "31"
        name = f"{self.prefix}_whole{_SUFFIX[kind]}"
        limit = f"{float(2 ** int(bits)):.1f}f"
        self.helpers[name] = (
            f"static {kind} {name}(float a) "
            f"{{ return -{limit} <= a && a < {limit} ? ({kind})a : INT{int(bits) + 1}_MIN; }}"
        )
        return f"{name}({bare(text)})"

    def helper(self, function: str, operands: Sequence[str], dtype: np.dtype) -> str:
        """A call of a function that the header brings along."""
        kind = C_TYPES[dtype.name]
        if function in _RAW:
            said, takes = _RAW[function]
            name = f"{self.prefix}_{function}"
            self.helpers[name] = f"static inline {kind} {name}({takes} a) {{ {said} }}"
            return f"{name}({bare(operands[0])})"
        name = f"{self.prefix}_{function}{_SUFFIX[kind]}"
        takes = ", ".join(f"{kind} {a}" for a in "ab"[: len(operands)])
        if function == "within":
            takes, operands = f"{takes}, int *outside", [*operands, "&outside"]
        self.helpers[name] = f"static {kind} {name}({takes}) {{ return {_HELPERS[function][kind != 'float']}; }}"
        return f"{name}({', '.join(map(bare, operands))})"

    def own_name(self, function: str) -> str:
        """As the C library's, behind the prefix."""
        return f"{self.prefix}_{function}f"

    def draw(self) -> str:
        """The next number of an agent's stream."""
        return f"{self.prefix}_uniform(memory)"

    def constant(self, place: Place, name: str) -> str:
        """The definition of a constant."""
        words, kind = lines_of(self.elements(place)), C_TYPES[place.dtype.name]
        line = f"{self.prefix.upper()}_ALIGNED static const {kind}"
        return f"{line} {name}[{max(1, place.size)}] = {{\n    {words}\n}};"
