"""Expressions of the loop language as text, and the statements that they take: a ``Language`` gives the words."""

from __future__ import annotations

from collections import Counter as Count
from collections.abc import Callable, Sequence

import numpy as np

from export_model.converters.graph.blocks import Packed
from export_model.converters.graph.language import Language, bare, comment, identifier
from export_model.converters.graph.nodes import NameScope
from export_model.converters.graph.ops.loops.base import (
    Applied,
    Counter,
    Drawn,
    Element,
    Expression,
    Given,
    Number,
    Reduced,
    Tensor,
)
from export_model.converters.graph.ops.loops.own_math import OWN
from export_model.converters.graph.program import Place, children, every
from export_model.converters.graph.types import BOOL, FLOAT32, INT32

#: What is kept by a reduction is called so.
KEPT = {"sum": "sum", "product": "product", "max": "largest", "min": "smallest"}
_COUNTERS = "ijklmnpqrstuvw"


class Expressions:
    """The statements of a program in the making; ``weight`` begins a constant's name, none is one of ``taken``."""

    def __init__(self, language: Language, weight: str, taken: Sequence[str] = ()) -> None:
        self.language = language
        self.draws = self.looks_up = False
        #: constants that are read in blocks, by name
        self.packed: dict[str, Packed] = {}
        self._weight = weight
        self._taken = taken
        self._scope = NameScope(taken)
        self._names: dict[int, str] = {}
        self._places: list[object] = []
        self._lines: list[str] = []
        self._depth = 1
        #: selects that the text in the making is a part of
        self._chosen = 0
        self._locals = NameScope(taken)
        self._counters: dict[int, str] = {}

    # ---- tensors

    def name(self, place: Place) -> str:
        """What a place is called in the text."""
        if id(place) not in self._names:
            word = identifier(place.name.removesuffix("/read"))[:60]  # TensorFlow's name of a variable's value
            wish = {"constant": f"{self._weight}{word}", "computed": f"t_{word}", "input": word}[place.kind]
            self.called(place, self._scope.fresh(wish))
        return self._names[id(place)]

    def called(self, place: Place, name: str) -> None:
        """Let a place be called so."""
        self._names[id(place)] = name
        self._places.append(place)

    def _say(self, line: str) -> None:
        self._lines.append("    " * self._depth + line)

    def _open(self, counter: Counter, first: int, last: int, step: int = 1) -> None:
        used = {*self._counters.values(), *self._taken}
        name = next((c for c in _COUNTERS if c not in used), None) or self._locals.fresh("i")
        self._counters[id(counter)] = name
        self._say(self.language.loop(name, first, last, step))
        self._depth += 1

    def _close(self) -> None:
        self._depth -= 1
        self._say("}")

    def _place(self, tensor: Tensor, at: Sequence[Expression], words: dict[int, str], shared: dict[int, int]) -> str:
        stride, terms = 1, list[str]()
        for length, one in reversed(list(zip(tensor.shape, at, strict=True))):
            text = self._text(one, words, shared)
            if text != "0":
                terms.append(bare(text) if stride == 1 else f"{text} * {stride}")
            stride *= length
        return f"{self.name(tensor.place)}[{' + '.join(reversed(terms)) or '0'}]"

    # ---- functions

    def _bring(self, function: str) -> None:
        """Define a mathematical function of ours, after those that it calls."""
        name, own = self.language.own_name(function), OWN[function]
        if name in self.language.helpers:
            return
        given = [Given(letter) for letter in "ab"[: own.function.__code__.co_argcount]]
        lines, result = Expressions(self.language, "")._expression(own.function(*given))
        about = comment(f"{function}: at most {own.ulps:g} units in the last place off, of {own.where}")
        text = self.language.definition(name, [g.name for g in given], lines, bare(result))
        self.language.helpers[name] = f"{about}\n{text}"

    def _expression(self, x: Expression) -> tuple[list[str], str]:
        """Statements, and what then stands for an expression of parameters."""
        self._lines, self._locals = [], NameScope([e.name for e in every(x) if isinstance(e, Given)])
        text = self._text(x, {}, count_reads(x))
        return self._lines, text

    def function(self, function: Callable[..., Expression], *names: str) -> str:
        """The text of a function of numbers that are called so; it takes no statements."""
        lines, text = Expressions(self.language, "")._expression(function(*map(Given, names)))
        assert not lines, names
        return bare(text)

    # ---- expressions

    def _text(self, x: Expression, words: dict[int, str], shared: dict[int, int]) -> str:
        if id(x) in words:
            return words[id(x)]
        if isinstance(x, Number):
            return self.language.literal(x.value, x.dtype)
        if isinstance(x, Given):
            return x.name
        if isinstance(x, Counter):
            text = self._counters[id(x)]
            return f"({text})" if " " in text else text
        if isinstance(x, Reduced):
            words[id(x)] = self._reduction(x, words, shared)
            return words[id(x)]
        if isinstance(x, Drawn):
            self.draws = True
            return self.language.draw()
        if isinstance(x, Element):
            return self._place(x.tensor, x.at, words, shared)
        self.looks_up |= x.function == "within"
        if x.function in self.language.ours:
            self._bring(x.function)
        chooses = x.function == "select" and bool(self.language.inline)
        if chooses and not self._chosen:
            for e in every(x.operands[0]):  # the condition reads it in any case
                if isinstance(e, Element) and id(e) not in words and shared.get(id(e), 0) > 1:
                    words[id(e)] = self._keep(e, self._place(e.tensor, e.at, words, shared))
        self._chosen += chooses
        operands = [self._text(o, words, shared) for o in x.operands]
        self._chosen -= chooses
        if chooses:
            operands[1:] = [self._ahead(o, text) for o, text in zip(x.operands[1:], operands[1:], strict=True)]
        text = self.language.applied(x, operands)
        if shared.get(id(x), 0) > 1:
            words[id(x)] = text = self._keep(x, text)
        return text

    def _keep(self, x: Expression, text: str) -> str:
        """The name of a local variable that is an expression."""
        name = self._locals.fresh("v")
        self._say(self.language.declaration(x.dtype, name, bare(text), constant=True))
        return name

    def _ahead(self, x: Expression, text: str) -> str:
        """Compute what may be chosen before it is: no branch, which would keep a compiler from making vectors.

        Not where an element is read: what is not chosen may lie outside of its tensor.
        """
        plain = "[" in text or bare(text).lstrip("-").isidentifier()
        return self._keep(x, text) if isinstance(x, Applied) and x.dtype == FLOAT32 and not plain else text

    def _start(self, x: Reduced) -> str:
        """What a reduction begins with."""
        kind, largest = x.body.dtype, x.kind in ("max", "first largest")
        if x.kind in ("sum", "product"):
            return self.language.literal(x.kind == "product", kind)
        if kind == BOOL:
            return self.language.literal(not largest, kind)
        if kind == FLOAT32:
            return self.language.literal(-np.inf if largest else np.inf, kind)
        info = np.iinfo(kind)
        return self.language.literal(info.min if largest else info.max, kind)

    def _accumulation(self, x: Reduced, text: str, values: Sequence[str], apart: str = "") -> str:
        """What is kept, and values added to it one after the other, or the largest or smallest; ``apart``: between."""
        function = {"sum": "add", "product": "mul"}.get(x.kind, x.kind)
        if x.body.dtype == BOOL:
            function = {"max": "or", "min": "and"}[x.kind]
        for value in values:
            text = self.language.applied(Applied(function, (x.body, x.body), x.body.dtype), [f"{text}{apart}", value])
        return text

    def _keep_all(self, x: Reduced, name: str, values: Sequence[str]) -> None:
        """Add values to what is kept, one after the other, or keep the largest or smallest."""
        text = bare(self._accumulation(x, name, values))
        if text == f"{name} + {values[0]}":
            self._say(f"{name} += {bare(values[0])};")
        else:
            self._say(f"{name} = {text};")

    def _reduction(self, x: Reduced, words: dict[int, str], shared: dict[int, int]) -> str:
        first, language = x.kind.startswith("first"), self.language
        before, depth = dict(self._counters), self._depth
        result = self._locals.fresh("found" if first else KEPT[x.kind])
        kind = x.body.dtype
        if first:
            best = self._locals.fresh("best")
            self._say(language.declaration(INT32, result, "0", constant=False))
            self._say(language.declaration(kind, best, self._start(x), constant=False))
        else:
            self._say(language.declaration(kind, result, self._start(x), constant=False))
        for counter in x.counters:
            self._open(counter, 0, counter.length)
        value = self._text(x.body, dict(words), shared)
        if first:
            one = self._locals.fresh("v")
            self._say(language.declaration(kind, one, bare(value), constant=True))
            better = f"{best} {'<' if x.kind == 'first largest' else '>'} {one}"
            self._say(f"if ({better}) {{ {best} = {one}; {result} = {self._counters[id(x.counters[0])]}; }}")
        else:
            self._keep_all(x, result, [value])
        while self._depth > depth:
            self._close()
        self._counters = before
        return result


def count_reads(x: Expression) -> dict[int, int]:
    """How many times each part of an expression is read."""
    return Count(id(c) for one in every(x) for c in children(one))
