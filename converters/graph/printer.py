"""Stages of a program as text: a loop nest for each. It knows the loop language, and asks a ``Language`` for words.

Where a stage adds up products, or keeps extremes, along its last axis, elements are computed together: in C all of a
row, some terms at a time (``rows``); elsewhere, and where it is short, eight side by side (``_LANES``): each number
that they share is read once, and there are eight independent chains to overlap.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from export_model.converters.graph.blocks import LANES, TERMS, Packed, packed_in, stride_of
from export_model.converters.graph.expressions import KEPT, Expressions, count_reads
from export_model.converters.graph.language import bare, comment
from export_model.converters.graph.nodes import NameScope
from export_model.converters.graph.ops.loops.base import (
    Applied,
    Counter,
    Drawn,
    Element,
    Expression,
    Reduced,
)
from export_model.converters.graph.program import Place, Program, Stage, children, every, inline_scalars, split_loop
from export_model.converters.graph.rows import TERMS as ROW_TERMS
from export_model.converters.graph.rows import in_rows, join_counters, take_guard
from export_model.converters.graph.types import BOOL, INT32

_LANES = 8
#: A counter, and a number that is added to it.
_SUM = re.compile(r"(\w+) \+ (\d+)")


class Printer(Expressions):
    """The statements of a program's stages."""

    def body(self, program: Program, depth: int = 1) -> list[str]:
        """The statements that compute a program's stages."""
        self._lines, self._depth = [], depth
        for stage in program.stages:
            self._stage(stage)
        return self._lines

    def inputs(self, program: Program) -> list[Place]:
        """The inputs that the statements of ``body`` or an output name."""
        words = {*re.findall(r"\w+", "\n".join(self._lines)), *(self.name(t.place) for t in program.outputs.values())}
        return [t.place for t in program.inputs.values() if self.name(t.place) in words]

    def _stage(self, stage: Stage) -> None:
        self._say(comment(stage.about[:200]))
        self._part(stage, stage.body, {})

    def _part(self, stage: Stage, body: Expression, bounds: dict[int, tuple[int, int]]) -> None:
        """The loops of a stage, or of the part of it in which its counters are within ``bounds``."""
        if found := split_loop(stage, body):
            counter, end, before, after = found
            first, last = bounds.get(id(counter), (0, counter.length))
            for low, high, each in ((first, min(end, last), before), (max(end, first), last, after)):
                if low < high:
                    self._part(stage, each, {**bounds, id(counter): (low, high)})
            return
        self._locals, self._counters, base = NameScope(self._taken), {}, self._depth
        summed = _side_by_side(stage, body)
        if summed is not None and not bounds:
            for counter in stage.counters[:-1]:
                self._open(counter, 0, counter.length)
            self._lanes(stage, body, summed)
        else:
            if not stage.counters:
                self._say("{")
                self._depth += 1
            for counter in stage.counters:
                self._open(counter, *bounds.get(id(counter), (0, counter.length)))
            self._assign(stage, body)
        while self._depth > base:
            self._close()

    def _assign(self, stage: Stage, body: Expression) -> None:
        words: dict[int, str] = {}
        text = self._text(body, words, count_reads(body))
        self._say(f"{self._place(stage.result, stage.at, words, {})} = {bare(text)};")

    def _lanes(self, stage: Stage, body: Expression, summed: Reduced) -> None:
        """Some elements of the last axis side by side, then, in place, what is made of each."""
        counter, outer = stage.counters[-1], dict(self._counters)
        if rows := self.language.rows and in_rows(Element(stage.result, stage.at), summed, counter):
            self._rows(stage, summed)
        packed = packed_in(summed, counter) if self.language.blocks else None
        first = counter.length if rows else 0
        for step in (*((LANES,) if packed else ()), min(_LANES, counter.length), 1):
            step = step if step > 1 else counter.length - first
            last = counter.length - (counter.length - first) % (step or 1)
            if first == last:
                continue
            if last - first > step:
                self._open(counter, first, last, step)
            else:
                self._say("{")
                self._depth += 1
            base = self._counters[id(counter)] if last - first > step else str(first)
            self._block(stage, summed, base, step, packed if step == LANES else None)
            self._close()
            first = last
        self._counters = outer
        if body is not summed:
            inner = inline_scalars(body, {id(summed): Element(stage.result, stage.at)})
            self._open_row(counter)
            self._assign(stage, inner)
            self._close()

    def _rows(self, stage: Stage, summed: Reduced) -> None:
        """Some terms at a time for all elements of the last axis, in place."""
        counter, depth, outer = stage.counters[-1], self._depth, dict(self._counters)
        guard, summed = take_guard(summed)
        summed = join_counters(summed, guard)
        last, start = summed.counters[-1], self._start(summed)
        one = guard is None and len(summed.counters) == 1 and last.length <= ROW_TERMS
        if not one:
            self._open(counter, 0, counter.length)
            self._say(f"{self._place(stage.result, stage.at, {}, {})} = {start};")
            self._close()
        inner = guard is not None and any(e is last for e in every(guard))
        for each in summed.counters[: None if inner else -1]:
            self._open(each, 0, each.length)
        if guard is not None:
            self._say(f"if ({bare(self._text(guard, {}, count_reads(guard)))}) {{")
            self._depth += 1
        terms = 1 if inner else ROW_TERMS
        whole = last.length // terms * terms
        if inner:
            self._row_terms(stage, summed, 1)
        elif whole > terms:
            self._open(last, 0, whole, terms)
            self._row_terms(stage, summed, terms)
            self._close()
        for begin in range(whole if whole > terms or inner else 0, last.length, terms):
            self._counters[id(last)] = str(begin)
            self._say("{")
            self._depth += 1
            self._row_terms(stage, summed, min(terms, last.length - begin), start if one else "")
            self._close()
        while self._depth > depth:
            self._close()
        self._counters = outer

    def _row_terms(self, stage: Stage, summed: Reduced, count: int, start: str = "") -> None:
        """Add so many terms to each element, or to ``start``: what they share is read before."""
        counter, last, shared = stage.counters[-1], summed.counters[-1], count_reads(summed)
        bases, known = [_plus(self._counters[id(last)], term) for term in range(count)], list[dict[int, str]]()
        for base in bases:
            self._counters[id(last)] = base
            words: dict[int, str] = {}
            for x in _common(summed.body, counter):
                name, text = self._locals.fresh("x"), bare(self._text(x, words, shared))
                self._say(self.language.declaration(x.dtype, name, text, constant=True))
                words[id(x)] = name
            known.append(words)
        self._counters[id(last)] = bases[0]
        self._open_row(counter)
        values = list[str]()
        for base, words in zip(bases, known, strict=True):
            self._counters[id(last)] = base
            values.append(self._text(summed.body, words, shared))
        name, line = self._place(stage.result, stage.at, {}, {}), "\n" + "    " * (self._depth + 1)
        self._say(f"{name} = {bare(self._accumulation(summed, start or name, values, line))};")
        self._close()

    def _open_row(self, counter: Counter) -> None:
        if self.language.apart:
            self._say(self.language.apart)
        self._open(counter, 0, counter.length)

    def _block(
        self,
        stage: Stage,
        summed: Reduced,
        base: str,
        count: int,
        packed: tuple[Packed, Element, Reduced] | None = None,
    ) -> None:
        """So many elements of the last axis, from ``base`` on."""
        counter = stage.counters[-1]
        indices = [_plus(base, i) for i in range(count)]
        self._counters[id(counter)] = base
        names = [self._locals.fresh(f"{KEPT[summed.kind]}{i}") for i in range(count)]
        start = self._start(summed)
        rest = "".join(f", {name} = {start}" for name in names[1:])
        self._say(self.language.declaration(summed.dtype, names[0], f"{start}{rest}", constant=False))
        outer, last = summed.counters[:-1], summed.counters[-1]
        at = self._begin_blocks(packed[0], base) if packed else ""
        for each in outer:
            self._open(each, 0, each.length)
        terms = TERMS if packed else self.language.terms if summed.kind == "sum" else 1
        whole = last.length // terms * terms
        lanes = dict(zip(names, indices, strict=True))

        def add(count: int) -> None:
            if packed:
                self._terms(packed[2], counter, lanes, count, (packed[1], self._next_block(packed[0], at)))
            else:
                self._terms(summed, counter, lanes, count)

        if whole:
            self._open(last, 0, whole, terms)
            add(terms)
            self._close()
        if whole < last.length:
            self._counters[id(last)] = str(whole)
            self._say("{")
            self._depth += 1
            add(last.length - whole)
            self._close()
        for _ in outer:
            self._close()
        self._counters[id(counter)] = base
        for name, text in zip(names, self._neighbours(Element(stage.result, stage.at), count, {}, {}), strict=True):
            self._say(f"{text} = {name};")

    def _begin_blocks(self, packed: Packed, base: str) -> str:
        """Where the blocks begin that sums from ``base`` on read."""
        at = self._locals.fresh("at")
        blocks = f"{base} / {LANES} * {packed.of_a_lane}" if not base.isdecimal() else "0"
        self._say(self.language.declaration(INT32, at, blocks, constant=False))
        return at

    def _next_block(self, packed: Packed, at: str) -> str:
        """What the next block is called."""
        name = f"{self.name(packed.place)}_blocks"
        same = (n for n, known in self.packed.items() if known == packed)
        wish = next(same, None) or self._scope.fresh(name)
        self.packed[wish] = packed
        block = self._locals.fresh("block")
        self._say(self.language.block(block, wish, at))
        return block

    def _terms(
        self,
        summed: Reduced,
        counter: Counter,
        lanes: Mapping[str, str],
        count: int,
        block: tuple[Element, str] | None = None,
    ) -> None:
        """Keep so many elements of a reduction's last axis, for each lane (what keeps it, and its index), in order.

        One that is read may come from a ``block``.
        """
        last, shared = summed.counters[-1], count_reads(summed)
        base, rows = self._counters[id(last)], dict[str, list[str]]()
        first: dict[int, str] = {}
        for term in range(count):
            self._counters[id(last)] = _plus(base, term)
            self._counters[id(counter)] = next(iter(lanes.values()))
            words: dict[int, str] = {}
            for x in _common(summed.body, counter):
                name = self._locals.fresh("x")
                text = (
                    self._element_after(x, last, term, first, shared) if isinstance(x, Element) and count > 1 else None
                )
                text = bare(self._text(x, words, shared)) if text is None else text
                self._say(self.language.declaration(x.dtype, name, text, constant=True))
                words[id(x)] = name
            each = [dict(words) for _ in lanes]
            if block:
                for lane, row in enumerate(each):
                    row[id(block[0])] = self.language.in_block(block[1], term * len(lanes) + lane)
            for x in every(summed.body):
                if isinstance(x, Element) and _only_last(x, counter) and not (block and x is block[0]):
                    moved = self._element_after(x, last, term, first, shared) if count > 1 else None
                    for row, text in zip(each, self._neighbours(x, len(lanes), words, shared, moved), strict=True):
                        row[id(x)] = text
            for (name, index), row in zip(lanes.items(), each, strict=True):
                self._counters[id(counter)] = index
                rows.setdefault(name, []).append(self._text(summed.body, row, shared))
        for name, values in rows.items():
            self._keep_all(summed, name, values)

    def _element_after(
        self, x: Element, last: Counter, term: int, first: dict[int, str], shared: dict[int, int]
    ) -> str | None:
        """An element that many numbers of a counter on from the ``first``; None if they are not equally far apart."""
        distance = stride_of(x, last)
        if distance is None:
            return None
        if term == 0:
            (first[id(x)],) = self._neighbours(x, 1, {}, shared)
        tensor, _, index = first[id(x)].removesuffix("]").partition("[")
        return f"{tensor}[{_plus(index, distance * term)}]"

    def _neighbours(
        self, x: Element, count: int, words: dict[int, str], shared: dict[int, int], text: str | None = None
    ) -> list[str]:
        """An element, ``text`` if that is known, and those after it, by an index that is computed once."""
        text = self._place(x.tensor, x.at, words, shared) if text is None else text
        tensor, _, index = text.removesuffix("]").partition("[")
        if not index.isidentifier() and " " in index and _SUM.fullmatch(index) is None:
            at = self._locals.fresh("at")
            self._say(self.language.declaration(INT32, at, index, constant=True))
            index = at
        return [f"{tensor}[{_plus(index, i)}]" for i in range(count)]


def _side_by_side(stage: Stage, body: Expression) -> Reduced | None:
    """The one reduction of a stage that differs along its last axis, if elements of that can be computed together."""
    reductions = [x for x in every(body) if isinstance(x, Reduced)]
    if len(reductions) != 1 or not stage.counters or any(isinstance(x, Drawn) for x in every(body)):
        return None
    (summed,) = reductions
    if summed.kind not in KEPT or summed.dtype != stage.result.dtype or summed.dtype == BOOL:
        return None
    return summed if any(x is stage.counters[-1] for x in every(summed.body)) else None


def _common(x: Expression, counter: Counter) -> list[Expression]:
    """The largest parts of an expression that read an element, or compare, and do not depend on a counter.

    Not those of a ``select`` that depends on it: what is not chosen may lie outside of its tensor.
    """
    if not any(e is counter for e in every(x)):
        reads = any(isinstance(e, Element) for e in every(x))
        return [x] if reads or (isinstance(x, Applied) and x.dtype == BOOL) else []
    parts = children(x)[:1] if isinstance(x, Applied) and x.function == "select" else children(x)
    return [found for part in parts for found in _common(part, counter)]


def _only_last(x: Element, counter: Counter) -> bool:
    """Whether the next number of a counter is the next element."""
    return bool(x.at) and x.at[-1] is counter and not any(e is counter for i in x.at[:-1] for e in every(i))


def _plus(index: str, count: int) -> str:
    """An index that far on."""
    if index.isdecimal():
        return str(int(index) + count)
    if found := _SUM.fullmatch(index):
        return _plus(found[1], int(found[2]) + count)
    return f"{index} + {count}" if count else index
