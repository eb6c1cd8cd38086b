"""Stages as C99 text: a loop nest for each, its sums before what is made of them. It knows functions, and no op."""

from __future__ import annotations

import re
from collections import Counter as Count
from collections.abc import Sequence

import numpy as np

from converters.graph.nodes import NameScope
from converters.graph.ops.loops.base import Applied, Counter, Drawn, Element, Expression, Number, Reduced, Tensor
from converters.graph.program import Place, Program, Stage, arena_of, children, every, split_loop
from converters.graph.types import FLOAT32, INT64

#: What C calls a dtype; a truth is an int, as C's comparisons are.
C_TYPES = {"float32": "float", "int32": "int32_t", "int64": "int64_t", "bool": "int32_t"}
_OPERATORS = {
    "add": "+",
    "sub": "-",
    "mul": "*",
    "div": "/",
    "less": "<",
    "less_equal": "<=",
    "equal": "==",
    "and": "&&",
    "or": "||",
}
_LIBM = {n: f"{n}f" for n in ("exp", "expm1", "log", "log1p", "sqrt", "sin", "cos", "tan", "tanh", "erf", "pow")} | {
    "floor": "floorf",
    "ceil": "ceilf",
    "rint": "rintf",
}
#: Functions that a program brings along: what they are for floats, and for whole numbers. $T: the type, $P: the prefix.
_HELPERS = {
    "max": ("a < b || b != b ? b : a", "a < b ? b : a"),
    "min": ("b < a || b != b ? b : a", "b < a ? b : a"),
    "abs": ("fabsf(a)", "a < 0 ? -a : a"),
    "mod": ("fmodf(a, b) + ((fmodf(a, b) != 0.0f && (fmodf(a, b) < 0.0f) != (b < 0.0f)) ? b : 0.0f)",
            "a % b + ((a % b != 0 && (a % b < 0) != (b < 0)) ? b : 0)"),
    "within": ("", "0 <= a && a < b ? a : (*outside = 1, 0)"),
    "intdiv": ("floorf(a / b)", "a / b - ((a % b != 0 && (a % b < 0) != (b < 0)) ? 1 : 0)"),
}  # fmt: skip
_SUFFIX = {"float": "f", "int32_t": "i", "int64_t": "l"}
_START = {"sum": "0", "product": "1"}
_WORDS = re.compile(r"[^0-9A-Za-z]+")
_PER_LINE = 12


def identifier(name: str) -> str:
    """A name as C takes it, without a letter or digit in front."""
    return _WORDS.sub("_", name).strip("_") or "x"


def literal(value: float, dtype: np.dtype) -> str:
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


def comment(text: str) -> str:
    """Return a text as a comment that it cannot leave: a source's names are a stranger's.

    A ``*`` and a ``/`` on two lines end a comment, too, where a backslash, or C99's ``??/`` for it, joins the lines.
    """
    safe = re.sub(r"[^ -~]|[\\?]", "_", text).replace("*/", "* /").replace("/*", "/ *")
    return f"/* {safe} */"


class Printer:
    """The functions of a program in the making; ``prefix`` begins every name of file scope."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.helpers: dict[str, str] = {}
        self.draws = False
        self.looks_up = False
        self._scope = NameScope(())
        self._names: dict[int, str] = {}
        self._keep: list[object] = []
        self._lines: list[str] = []
        self._depth = 1
        self._counted = 0

    # ---- tensors

    def name(self, place: Place) -> str:
        """What a place is called in the text."""
        if id(place) not in self._names:
            word = identifier(place.name)[:60]
            wish = {"constant": f"{self.prefix}_w_{word}", "computed": f"t_{word}", "input": word}[place.kind]
            self._names[id(place)] = self._scope.fresh(wish)
            self._keep.append(place)
        return self._names[id(place)]

    def called(self, place: Place, name: str) -> None:
        """Let a place be called so."""
        self._names[id(place)] = name
        self._keep.append(place)

    def constant(self, place: Place) -> str:
        """Its definition."""
        assert place.value is not None
        value = place.value.reshape(-1)
        if place.dtype == FLOAT32 and np.isfinite(value).all():
            words = [f"{x:.9g}" for x in value.tolist()]
            numbers = [f"{w if '.' in w or 'e' in w else w + '.0'}f" for w in words]
        else:
            numbers = [literal(x, place.dtype) for x in value.tolist()]
        rows = [", ".join(numbers[i : i + _PER_LINE]) for i in range(0, len(numbers), _PER_LINE)]
        body = ",\n    ".join(rows)
        kind = C_TYPES[place.dtype.name]
        return f"static const {kind} {self.name(place)}[{max(1, place.size)}] = {{\n    {body}\n}};"

    # ---- stages

    def body(self, program: Program) -> list[str]:
        """The statements that compute a program's stages."""
        self._lines = []
        for stage in program.stages:
            place = stage.result.place
            kind = C_TYPES[place.dtype.name]
            self._say(f"{kind} *const {self.name(place)} = memory->{arena_of(place.dtype)} + {place.offset};")
        for stage in program.stages:
            self._stage(stage)
        return self._lines

    def _say(self, line: str) -> None:
        self._lines.append("    " * self._depth + line)

    def _stage(self, stage: Stage) -> None:
        self._say(comment(stage.about[:200]))
        self._part(stage, stage.body, {})

    def _part(self, stage: Stage, body: Expression, bounds: dict[str, tuple[int, int]]) -> None:
        """The loops of a stage, or of the part of it in which its counters are within ``bounds``."""
        if found := split_loop(stage, body):
            counter, end, before, after = found
            first, last = bounds.get(counter.name, (0, counter.length))
            for low, high, each in ((first, min(end, last), before), (max(end, first), last, after)):
                if low < high:
                    self._part(stage, each, {**bounds, counter.name: (low, high)})
            return
        self._say("{")
        self._depth += 1
        for counter in stage.counters:
            self._open(counter, *bounds.get(counter.name, (0, counter.length)))
        known: dict[int, str] = {}
        text = self._text(body, known, _shared(body))
        self._say(f"{self.name(stage.result.place)}[{self._index(stage.result, stage.at, known, {})}] = {_bare(text)};")
        for _ in stage.counters:
            self._close()
        self._close()

    def _open(self, counter: Counter, first: int, last: int) -> None:
        n = counter.name
        self._say(f"for (int {n} = {first}; {n} < {last}; {n}++) {{")
        self._depth += 1

    def _close(self) -> None:
        self._depth -= 1
        self._say("}")

    def _index(self, tensor: Tensor, at: Sequence[Expression], known: dict[int, str], shared: dict[int, int]) -> str:
        stride, terms = 1, list[str]()
        for length, one in reversed(list(zip(tensor.shape, at, strict=True))):
            if not (isinstance(one, Number) and one.value == 0):
                text = self._text(one, known, shared)
                terms.append(text if stride == 1 else f"{text} * {stride}")
            stride *= length
        return " + ".join(reversed(terms)) or "0"

    # ---- expressions

    def _text(self, x: Expression, known: dict[int, str], shared: dict[int, int]) -> str:
        if id(x) in known:
            return known[id(x)]
        if isinstance(x, Number):
            return literal(x.value, x.dtype)
        if isinstance(x, Counter):
            return x.name
        if isinstance(x, Reduced):
            known[id(x)] = self._reduced(x, known, shared)
            return known[id(x)]
        if isinstance(x, Drawn):
            self.draws = True
            return f"{self.prefix}_uniform(memory)"
        if isinstance(x, Element):
            source = self.name(x.tensor.place)
            return f"{source}[{self._index(x.tensor, x.at, known, shared)}]"
        text = self._applied(x, [self._text(o, known, shared) for o in x.operands])
        if shared.get(id(x), 0) > 1:
            name = self._local("v")
            self._say(f"const {C_TYPES[x.dtype.name]} {name} = {_bare(text)};")
            known[id(x)] = text = name
        return text

    def _local(self, letter: str) -> str:
        self._counted += 1
        return f"{letter}{self._counted}"

    def _applied(self, x: Applied, operands: list[str]) -> str:
        function, kind = x.function, C_TYPES[x.dtype.name]
        if function in _OPERATORS:
            return f"({operands[0]} {_OPERATORS[function]} {operands[1]})"
        if function == "select":
            return f"({operands[0]} ? {operands[1]} : {operands[2]})"
        if function == "cast":
            return f"({kind}){operands[0]}"
        if function in ("neg", "not"):
            return f"({'-' if function == 'neg' else '!'}{operands[0]})"
        if function in _HELPERS:
            name = f"{self.prefix}_{function}{_SUFFIX[kind]}"
            takes = ", ".join(f"{kind} {a}" for a in "ab"[: len(operands)])
            said = _HELPERS[function][kind != "float"]
            if function == "within":
                self.looks_up = True
                takes, operands = f"{takes}, int *outside", [*operands, "&outside"]
            self.helpers[name] = f"static {kind} {name}({takes}) {{ return {said}; }}"
            return f"{name}({', '.join(operands)})"
        if kind != "float":  # whole numbers are whole
            return f"({kind}){_LIBM[function]}({', '.join(f'(float){o}' for o in operands)})"
        return f"{_LIBM[function]}({', '.join(operands)})"

    def _reduced(self, x: Reduced, known: dict[int, str], shared: dict[int, int]) -> str:
        result = self._local("r")
        body_kind = x.body.dtype
        first = x.kind.startswith("first")
        largest = x.kind in ("max", "first largest")
        kind = C_TYPES[body_kind.name]
        if body_kind == FLOAT32:
            bound = "-INFINITY" if largest else "INFINITY"
        else:
            bound = f"{'INT64' if body_kind == INT64 else 'INT32'}_{'MIN' if largest else 'MAX'}"
        start = f"{_START[x.kind]}{'.0f' if kind == 'float' else ''}" if x.kind in _START else bound
        if first:
            best = self._local("b")
            self._say(f"int32_t {result} = 0;")
            self._say(f"{kind} {best} = {bound};")
        else:
            self._say(f"{kind} {result} = {start};")
        for counter in x.counters:
            self._open(counter, 0, counter.length)
        value = self._text(x.body, inner := dict(known), shared)
        if first:
            held = self._local("v")
            self._say(f"const {kind} {held} = {_bare(value)};")
            self._say(
                f"if ({best} {'<' if largest else '>'} {held}) {{ {best} = {held}; {result} = {x.counters[0].name}; }}"
            )
        elif x.kind in _START:
            self._say(f"{result} {'+' if x.kind == 'sum' else '*'}= {_bare(value)};")
        else:
            say = Applied(x.kind, (x.body, x.body), body_kind)
            self._say(f"{result} = {self._applied(say, [result, _bare(value)])};")
        del inner
        for _ in x.counters:
            self._close()
        return result


def _shared(x: Expression) -> dict[int, int]:
    """How many times each part of an expression is read."""
    return Count(id(c) for one in every(x) for c in children(one))


def _bare(text: str) -> str:
    """Without the parentheses around all of it."""
    if not (text.startswith("(") and text.endswith(")")):
        return text
    depth = 0
    for i, c in enumerate(text):
        depth += {"(": 1, ")": -1}.get(c, 0)
        if depth == 0 and i < len(text) - 1:
            return text
    return text[1:-1]
