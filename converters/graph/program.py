"""A graph as a program of loops for one agent: stages in their order, elementwise ones within those before them.

What is computed lies in one arena per C-like type, planned once: a place is given to another tensor when its last
reader has run. Nothing here knows a language.
"""

from __future__ import annotations

from collections import Counter as Count
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.graph.nodes import Graph, Node, TensorShape, ref
from export_model.converters.graph.ops.loops.base import (
    DTYPES,
    Applied,
    Counter,
    Drawn,
    Element,
    Expression,
    Index,
    Kind,
    Number,
    Reduced,
    Tensor,
    apply,
    loop_error,
    number,
)
from export_model.converters.graph.ops.table import is_fed, op_of
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import BOOL, FLOAT32, INT64, TensorType


class Place(Struct, eq=False):
    """What holds the elements of a tensor: an input, a constant (``value``), or a part of the arena from ``offset``."""

    kind: str
    name: str
    dtype: np.dtype
    size: int
    value: np.ndarray | None = None
    offset: int = 0


class Stage(Struct, frozen=True, eq=False):
    """One nest of loops: every element of ``result``, and the layer of the source that it stands for."""

    result: Tensor
    counters: tuple[Counter, ...]
    at: tuple[Expression, ...]
    body: Expression
    about: str


class Program(Struct, frozen=True, eq=False):
    """Stages in their order, the constants that they read, the inputs and outputs by name, the size of each arena.

    Frozen: one program is printed in several languages, each after the other.
    """

    stages: tuple[Stage, ...]
    inputs: dict[str, Tensor]
    outputs: dict[str, Tensor]
    arenas: Mapping[str, int]

    @property
    def constants(self) -> list[Place]:
        """In the order in which they are read."""
        found = dict.fromkeys(e.tensor.place for s in self.stages for e in elements(s.body))
        found |= dict.fromkeys(t.place for t in self.outputs.values())
        return [p for p in found if p.kind == "constant"]


def children(x: Expression) -> tuple[Expression, ...]:
    """The expressions that one is made of."""
    if isinstance(x, Element):
        return x.at
    if isinstance(x, Applied):
        return x.operands
    return (x.body,) if isinstance(x, Reduced) else ()


def every(x: Expression) -> Iterator[Expression]:
    """An expression and all that it is made of, each once."""
    seen: dict[int, Expression] = {}
    stack = [x]
    while stack:
        one = stack.pop()
        if id(one) not in seen:
            seen[id(one)] = one
            stack.extend(children(one))
            yield one


def elements(x: Expression) -> list[Element]:
    """The elements of tensors that an expression reads."""
    return [e for e in every(x) if isinstance(e, Element)]


def split_loop(stage: Stage, body: Expression) -> tuple[Counter, int, Expression, Expression] | None:
    """Where a loop of a stage is two, one after the other, as in a concatenation: (counter, where, before, after)."""
    if not (isinstance(body, Applied) and body.function == "select"):
        return None
    condition, before, after = body.operands
    if not (isinstance(condition, Applied) and condition.function == "less"):
        return None
    counter, end = condition.operands
    if counter not in stage.counters or not isinstance(counter, Counter) or not isinstance(end, Number):
        return None
    return counter, int(end.value), before, after


def arena_of(dtype: np.dtype) -> str:
    """The arena that holds tensors of a dtype."""
    return "floats" if dtype == FLOAT32 else "longs" if dtype == INT64 else "ints"


class _ProgramBuilder:
    def __init__(self, graph: Graph) -> None:
        self.types = infer_types(graph)
        self.tensors: dict[str, Tensor] = {}
        self.stages: list[Stage] = []
        self.node: Node | None = None
        self._counted = 0

    def type_of(self, reference: str) -> TensorType:
        return self.types[reference]

    def value(self, reference: str) -> Tensor:
        if reference not in self.tensors:
            constant = self.types[reference].constant
            assert constant is not None and self.node is not None
            self._check(constant.dtype)
            place = Place("constant", reference, constant.dtype, constant.size, constant)
            self.tensors[reference] = Tensor(place, constant.dtype, tuple(int(n) for n in constant.shape))
        return self.tensors[reference]

    def _check(self, dtype: np.dtype) -> None:
        if dtype not in DTYPES:
            assert self.node is not None
            raise loop_error(self.node, f"programs compute in float32, int32, int64 and bool, not in {dtype}")

    def _counters(self, lengths: Sequence[int]) -> tuple[tuple[Counter, ...], tuple[Expression, ...]]:
        made, at = list[Counter](), list[Expression]()
        for length in lengths:
            if length == 1:
                at.append(number(0))
                continue
            self._counted += 1
            made.append(Counter(f"i{self._counted}", int(length)))
            at.append(made[-1])
        return tuple(made), tuple(at)

    def compute(
        self, shape: Sequence[int], element: Callable[[tuple[Expression, ...]], Expression], dtype: np.dtype
    ) -> Tensor:
        assert self.node is not None
        self._check(dtype)
        if 0 in shape:
            raise loop_error(self.node, "a tensor of it is empty")
        counters, at = self._counters(shape)
        place = Place("computed", self.node.name, dtype, int(np.prod(shape, dtype=np.int64)))
        result = Tensor(place, dtype, tuple(int(n) for n in shape))
        origin = self.node.origin
        op = self.node.op.removeprefix("_Fused")
        words = {origin} if isinstance(origin, str) else {*(origin or ())}
        source = "".join(f" ({w})" for w in sorted(words - {self.node.name, f"{self.node.name}:0"}))
        about = f"{op} {self.node.name}{source}"
        self.stages.append(Stage(result, counters, at, inline_scalars(element(at)), about))
        return result

    def reduce(
        self, kind: Kind, lengths: Sequence[int], body: Callable[[tuple[Expression, ...]], Expression], dtype: np.dtype
    ) -> Expression:
        if dtype == BOOL and kind in ("sum", "product"):
            assert self.node is not None
            raise loop_error(self.node, f"a {kind} of truth values: programs add and multiply numbers")
        counters, at = self._counters(lengths)
        if not counters and not kind.startswith("first"):
            return body(at)
        return Reduced(kind, counters, body(at), dtype) if counters else number(0)


def inline_scalars(x: Expression, swap: Mapping[int, Expression] | None = None) -> Expression:
    """An expression with constants of one element as numbers, and others in the place of some (``swap``, by id)."""
    done: dict[int, Expression] = dict(swap or {})

    def visit(one: Expression) -> Expression:
        if id(one) in done:
            return done[id(one)]
        made = one
        if isinstance(one, Element):
            value = one.tensor.place.value
            made = (
                Number(value.reshape(-1)[0].item(), one.dtype)
                if value is not None and value.size == 1
                else replace(one, at=tuple(map(visit, one.at)))
            )
        elif isinstance(one, Applied):
            made = apply(one.function, *map(visit, one.operands), dtype=one.dtype)
        elif isinstance(one, Reduced):
            made = replace(one, body=visit(one.body))
        done[id(one)] = made
        return made

    return visit(x)


def program_of(graph: Graph, feeds: Mapping[str, str], fetches: Mapping[str, str]) -> Program:
    """The program of a graph for one agent; inputs and outputs by the names of ``feeds`` and ``fetches``.

    Raises UnsupportedOpError.
    """
    graph = Graph(tuple(_for_one(n) for n in graph.nodes)).prune(fetches.values())
    builder = _ProgramBuilder(graph)
    inputs: dict[str, Tensor] = {}
    names = {placeholder: name for name, placeholder in feeds.items()}
    for node in graph.nodes:
        builder.node, kind = node, builder.types[node.name]
        if is_fed(node):
            shape = tuple(n for n in kind.shape or () if isinstance(n, int))
            if kind.shape is None or len(shape) < len(kind.shape) or kind.dtype not in DTYPES:
                raise loop_error(node, "its type and length must be known: float32, int32, int64 or bool")
            place = Place("input", names[node.name], kind.dtype, int(np.prod(shape, dtype=np.int64)))
            builder.tensors[node.name] = inputs[names[node.name]] = Tensor(place, kind.dtype, shape)
        elif kind.constant is None:
            loops = op_of(node).loops
            if loops is None:
                raise loop_error(node, "it has no loops yet")
            made = loops(node, builder)
            for i, tensor in enumerate(made if isinstance(made, tuple) else (made,)):
                builder.tensors[ref(node.name, i)] = tensor
    outputs = {name: builder.value(reference) for name, reference in fetches.items()}
    given = {t.place for t in outputs.values()}
    stages = _join(_leave_out(builder.stages, given), given)
    return Program(tuple(stages), inputs, outputs, _plan(stages, given))


def _for_one(node: Node) -> Node:
    if not is_fed(node) or not node.dims or node.dims[0] is not None:
        return node
    return replace(node, attrs={**node.attrs, "shape": TensorShape((1, *node.dims[1:]))})


def _leave_out(stages: Sequence[Stage], given: Set[Place]) -> list[Stage]:
    """Return the stages that others, or what is ``given`` as an output, need."""
    needed, kept = set(given), list[Stage]()
    for stage in reversed(stages):
        if stage.result.place in needed:
            needed |= {e.tensor.place for e in elements(stage.body)}
            kept.append(stage)
    return kept[::-1]


#: Terms of one loop's expression: a chain of ops without end would be one expression, which a compiler, too, reads
#: recursively. The largest of the public policies has some hundred.
MAX_TERMS = 512


def _join(stages: list[Stage], given: Set[Place]) -> list[Stage]:
    """A stage that one other alone reads, element by element and in the same loops, becomes a part of that.

    Not two that reduce: a printer computes eight elements of one reduction side by side.
    """
    while len(joined := _join_once(stages, given)) < len(stages):
        stages = joined
    return stages


def _join_once(stages: Sequence[Stage], given: Set[Place]) -> list[Stage]:
    """Join each stage with those that it alone reads."""
    made: dict[Any, Stage] = {s.result.place: s for s in stages}
    readers = Count(p for s in stages for p in {e.tensor.place for e in elements(s.body)})
    alone = {p: s for p, s in made.items() if readers[p] == 1 and p not in given}
    traits = {p: _traits_of(s.body) for p, s in made.items()}
    gone: set[Any] = set()
    for stage in stages:
        swap: dict[int, Expression] = {}
        own, abouts = traits[stage.result.place], list[str]()
        for place, found in _reads(stage, alone, own).items():
            before, other = made[place], traits[place]
            if other.draws or split_loop(before, before.body) or (own.reduces and other.reduces):
                continue
            if own.terms + other.terms > MAX_TERMS:
                break
            own = _Traits(own.terms + other.terms, own.reduces or other.reduces, own.draws)
            turned = {id(a): b for a, b in zip(before.counters, stage.counters, strict=True)}
            swap |= dict.fromkeys(map(id, found), inline_scalars(before.body, turned))
            gone.add(place)
            abouts.append(before.about)
        if swap:
            about, body = ", ".join([*abouts, stage.about]), inline_scalars(stage.body, swap)
            made[stage.result.place] = replace(stage, about=about, body=body)
            traits[stage.result.place] = own
    return [stage for place, stage in made.items() if place not in gone]


class _Traits(NamedTuple):
    """What decides whether an expression may be joined; kept, since a chain of ops would be walked again and again."""

    terms: int
    reduces: bool
    draws: bool


def _traits_of(x: Expression) -> _Traits:
    terms = list(every(x))
    return _Traits(
        len(terms), any(isinstance(one, Reduced) for one in terms), any(isinstance(one, Drawn) for one in terms)
    )


def _reads(stage: Stage, made: Mapping[Any, Stage], own: _Traits) -> dict[Any, list[Element]]:
    """Place → where a stage reads it, of those that it reads element by element, each in its own loops."""
    terms = list(every(stage.body))
    within = {id(e) for r in terms if isinstance(r, Reduced) for e in every(r.body)} if own.reduces else set()
    found: dict[Any, list[Element]] = {}
    for e in terms:
        if isinstance(e, Element) and e.tensor.place in made:
            found.setdefault(e.tensor.place, []).append(e)
    return {
        place: read
        for place, read in found.items()
        if all(id(e) not in within and _same_place(e, made[place], stage) for e in read)
    }


def _same_place(e: Element, before: Stage, stage: Stage) -> bool:
    if e.tensor.shape != before.result.shape or len(before.counters) != len(stage.counters):
        return False
    return [i for i in e.at if not isinstance(i, Number)] == list(stage.counters) and all(
        a.length == b.length for a, b in zip(before.counters, stage.counters, strict=True)
    )


def _plan(stages: Sequence[Stage], given: Set[Place]) -> dict[str, int]:
    """Give each computed tensor a part of its arena that is free as long as it is read; return the arenas' sizes."""
    last: dict[Any, int] = {}
    for i, stage in enumerate(stages):
        last |= {e.tensor.place: i for e in elements(stage.body)}
    last |= dict.fromkeys(given, len(stages))
    taken, arenas = dict[str, list[tuple[int, int, int]]](), dict[str, int]()
    for i, stage in enumerate(stages):
        place = stage.result.place
        arena = arena_of(place.dtype)
        live = sorted((a, b) for a, b, until in taken.get(arena, []) if until >= i)
        start = 0
        for a, b in live:
            if start + place.size <= a:
                break
            start = max(start, b)
        place.offset = start
        taken.setdefault(arena, []).append((start, start + place.size, last[place]))
        arenas[arena] = max(arenas.get(arena, 0), start + place.size)
    return arenas


__all__ = ["Index", "Place", "Program", "Stage", "arena_of", "children", "elements", "every", "program_of"]
