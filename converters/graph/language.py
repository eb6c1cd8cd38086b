"""What a programming language is to the printer: its words for numbers, functions and loops, and what all share."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import numpy as np

from export_model.converters.graph.ops.loops.base import Applied, Number
from export_model.converters.graph.ops.loops.own_math import OWN
from export_model.converters.graph.program import Place
from export_model.converters.graph.types import FLOAT32

_WORDS = re.compile(r"[^0-9A-Za-z]+")
_INFIX = {
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
_PER_LINE = 12


def identifier(name: str) -> str:
    """A name as languages take it, without a letter or digit in front."""
    return _WORDS.sub("_", name).strip("_") or "x"


def in_comment(text: str) -> str:
    """Return a text as words of a comment that it cannot leave: a source's names are untrusted.

    A ``*`` and a ``/`` on two lines end a comment, too, where a backslash, or C99's ``??/`` for it, joins the lines.
    """
    return re.sub(r"[^ -~]|[\\?]", "_", text).replace("*/", "* /").replace("/*", "/ *")


def comment(text: str) -> str:
    """Return a text as a comment."""
    return f"/* {in_comment(text)} */"


def lines_of(words: Sequence[str]) -> str:
    """Numbers of an array, twelve on a line."""
    rows = (", ".join(words[i : i + _PER_LINE]) for i in range(0, len(words), _PER_LINE))
    return ",\n    ".join(rows)


class Language(ABC):
    """The words of a programming language.

    ``helpers`` are the functions that a program brings along, by name, each after those that it calls. ``own``:
    mathematical functions are ours, and every result is rounded to its dtype.
    """

    #: Function of float32 → how it is written; ``{0}`` and ``{1}`` are the operands.
    functions: Mapping[str, str] = {}
    #: Products that are added in one statement, in their order: more where a compiler keeps sums in memory between two.
    terms = 1
    #: Whether constants are read in blocks (``export_model.converters.graph.blocks``).
    blocks = False
    #: Whether terms of a reduction are added to a row in place (``export_model.converters.graph.rows``).
    rows = False
    #: What stands before a loop over a row, which nothing that is read overlaps with.
    apart = ""
    #: How a finite float32 stands in an array, where its type is said before.
    element = "{}f"
    #: What the variable of a loop is declared as.
    counter = "int"

    #: Mathematical functions that are ours in any case.
    fast: frozenset[str] = frozenset()
    #: How the definition of a function begins that loops call, where a compiler puts it into them.
    inline = ""
    #: How a float32 within the range of an int32 becomes one.
    whole = "(int){}"

    def __init__(self, own: bool = False) -> None:
        self.helpers: dict[str, str] = {}
        self.own = own
        self.ours = frozenset(OWN) if own else self.fast

    @abstractmethod
    def literal(self, value: float, dtype: np.dtype) -> str:
        """A number, to the last bit."""

    @abstractmethod
    def declaration(self, dtype: np.dtype, name: str, value: str, *, constant: bool) -> str:
        """A local variable."""

    def loop(self, name: str, first: int, last: int, step: int) -> str:
        """The head of a loop."""
        return (
            f"for ({self.counter} {name} = {first}; {name} < {last}; {name}{'++' if step == 1 else f' += {step}'}) {{"
        )

    @abstractmethod
    def cast(self, text: str, source: np.dtype, target: np.dtype) -> str:
        """A number of another dtype."""

    @abstractmethod
    def helper(self, function: str, operands: Sequence[str], dtype: np.dtype) -> str:
        """A call of a function that the program brings along."""

    @abstractmethod
    def own_name(self, function: str) -> str:
        """What a mathematical function of ours is called."""

    def definition(self, name: str, takes: Sequence[str], lines: Sequence[str], result: str) -> str:
        """The definition of a function of float32: its statements, and what it gives."""
        words = ", ".join(f"float {a}" for a in takes)
        return "\n".join([f"static {self.inline}float {name}({words})\n{{", *lines, f"    return {result};\n}}"])

    @abstractmethod
    def draw(self) -> str:
        """The next number of the stream of draws."""

    def block(self, name: str, packed: str, at: str) -> str:
        """The declaration of the block of an array that is next, where ``blocks``."""
        raise NotImplementedError

    def in_block(self, name: str, number: int) -> str:
        """A number of a block, where ``blocks``."""
        raise NotImplementedError

    def round_to(self, text: str, x: Applied) -> str:
        """What an operator gives, in the precision of its dtype."""
        return text

    def elements(self, place: Place) -> list[str]:
        """A constant's numbers as the initialiser of an array lists them; halves by their 16 bits."""
        assert place.value is not None
        value = place.value.reshape(-1)
        if value.dtype in (np.int8, np.float16):
            return [str(x) for x in (value if value.dtype == np.int8 else value.view(np.uint16)).tolist()]
        if value.dtype == FLOAT32 and np.isfinite(value).all():
            words = (f"{x:.9g}" for x in value.tolist())  # reads back to the same bits
            return [self.element.format(w if "." in w or "e" in w else f"{w}.0") for w in words]
        return [self.literal(x, value.dtype) for x in value.tolist()]

    def applied(self, x: Applied, operands: Sequence[str]) -> str:
        """A function of operands."""
        function = x.function
        if function in self.ours:
            return f"{self.own_name(function)}({', '.join(map(bare, operands))})"
        if function in _INFIX:
            return self.round_to(f"({operands[0]} {_INFIX[function]} {operands[1]})", x)
        if function == "select" and isinstance(x.operands[0], Number):
            return operands[1 if x.operands[0].value else 2]
        if function == "select":
            return f"({operands[0]} ? {operands[1]} : {operands[2]})"
        if function == "whole":
            return f"({self.whole.format(operands[0])})"
        if function == "cast":
            return self.cast(operands[0], x.operands[0].dtype, x.dtype)
        if function in ("neg", "not"):
            return f"({'-' if function == 'neg' else '!'}{operands[0]})"
        if function not in self.functions:
            return self.helper(function, operands, x.dtype)
        if x.dtype == FLOAT32:
            return self.round_to(self.functions[function].format(*map(bare, operands)), x)
        wide = [self.cast(o, x.dtype, np.dtype(np.float32)) for o in operands]  # whole numbers are whole
        return self.cast(self.functions[function].format(*wide), np.dtype(np.float32), x.dtype)


def bare(text: str) -> str:
    """Without the parentheses around all of it."""
    if not (text.startswith("(") and text.endswith(")")):
        return text
    depth = 0
    for i, c in enumerate(text):
        depth += {"(": 1, ")": -1}.get(c, 0)
        if depth == 0 and i < len(text) - 1:
            return text
    return text[1:-1]
