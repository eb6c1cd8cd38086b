"""What an input of a policy is for: rules on its name, then on its shape and what reads it."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from msgspec import Struct

from export_model.converters.graph.nodes import Graph, Node, downstream
from export_model.converters.graph.ops.table import passes_on, traits
from export_model.converters.policy.memories import looks_like_state
from export_model.converters.policy.observations import highest_colour
from export_model.converters.policy.rules import Rule, always
from export_model.signatures.roles import INPUT_PATTERNS, Role

#: Names of cameras: ML-Agents' own, and words that say so.
_CAMERA = re.compile(r"^obs_\d+$|^observation_\d+$|visual|camera|image|pixel|rgb|screen|frame")
_LEAST_IMAGE = 20
_IMAGE, _MATRIX = 4, 2
#: What is counted by whole numbers.
_COUNTED = (Role.SEQUENCE_LENGTH, Role.BATCH_SIZE, Role.PREV_ACTION)


class ScopedInput(Struct, frozen=True):
    """A placeholder and its name without the scope of its brain."""

    base: str
    node: Node


class Read(Struct, frozen=True):
    """A placeholder whose name says nothing, in its graph.

    ``declared``: the format says what its inputs are; ``recurrent``: another is a memory; ``observed``: an observation
    was found before it.
    """

    node: Node
    graph: Graph
    consumers: Mapping[str, list[Node]]
    declared: bool
    recurrent: bool
    observed: bool


# ------------------------------------------------------------------ shapes


def placeholder_rank(node: Node) -> int | None:
    """Number of axes of a placeholder, None if the graph does not say."""
    return None if node.dims is None else len(node.dims)


def is_whole(node: Node) -> bool:
    """Whether a placeholder takes integers."""
    dtype = node.attrs.get("dtype")
    return isinstance(dtype, np.dtype) and dtype.kind in "iu"


def is_free(node: Node) -> bool:
    """Whether the first axis of a placeholder is that of the agents, and it is [B] or [B, n]."""
    dims = node.dims or ()
    return len(dims) in (1, 2) and dims[0] is None


def is_board(name: str, node: Node) -> bool:
    """Whether a placeholder of rank 4 is a board of a game (or a grid of objects): smaller than any camera's image.

    The least that an encoder of ML-Agents takes is 20x20 (match3, for boards, takes 5x5: what is called as ML-Agents
    calls its cameras is one), of Stable-Baselines3 36x36; Connect Four is 6x7, MiniGrid 7x7, chess 8x8, Go 19x19.
    """
    dims = node.dims or ()
    sizes = [n for n in dims[1:] if n is not None]
    named = _CAMERA.search(name.rpartition("/")[2].lower()) is not None
    return len(dims) == len(sizes) + 1 == 4 and sorted(sizes)[1] < _LEAST_IMAGE and not named


def _is_fixed(node: Node) -> bool:
    """Whether a placeholder has rows of a fixed shape."""
    dims = node.dims or ()
    return len(dims) > 1 and dims[0] is None and None not in dims[1:]


def _has_rows(node: Node) -> bool:
    """Whether a placeholder is [B, n] or [B, T, n]; a single number a row may be a flag that resets the memory."""
    dims = node.dims or ()
    return len(dims) in (2, 3) and dims[0] is None and dims[-1] is not None and (dims[-1] > 1 or len(dims) > 2)


def _is_image(seen: Read) -> bool:
    whole = is_whole(seen.node) and seen.node.attrs.get("dtype") != np.uint8
    return placeholder_rank(seen.node) == _IMAGE and not whole


def _is_in_rows(seen: Read) -> bool:
    """Whether it is numbers, as many for each agent, beside no memory."""
    plain = seen.declared and not is_whole(seen.node) and not seen.recurrent
    return plain and is_free(seen.node) and placeholder_rank(seen.node) == _MATRIX


def _has_several(seen: Read) -> bool:
    """Whether it is rows of numbers for each agent, by its name no memory."""
    named = looks_like_state(seen.node.name)
    return seen.declared and _has_rows(seen.node) and not is_whole(seen.node) and not named


def _has_several_axes(seen: Read) -> bool:
    several = _is_fixed(seen.node) and (placeholder_rank(seen.node) or 0) > _MATRIX
    return seen.declared and several and not looks_like_state(seen.node.name)


# ------------------------------------------------------------------ what reads it


def _shows(node: Node) -> bool:
    """Whether a node passes its operand on, or parts of it."""
    return passes_on(node) or traits(node).moves == "pick"


def _is_chosen(seen: Read) -> bool:
    """Whether it is integers that a one-hot is made of."""
    if not is_whole(seen.node) or placeholder_rank(seen.node) not in (1, 2):
        return False
    readers = downstream(seen.node, seen.consumers, lambda n: _shows(n) or n.op == "Cast")
    return any(r.op == "OneHot" for r in readers)


def _picks_rows(seen: Read) -> bool:
    """Whether it is integers that say which rows of a constant are taken."""
    if not (seen.declared and is_whole(seen.node) and not seen.recurrent and is_free(seen.node)):
        return False
    readers = downstream(seen.node, seen.consumers, lambda n: _shows(n) or traits(n).elementwise)
    picked = [r for r in readers if traits(r).moves == "pick" and len(r.inputs) > 1]
    return any(seen.graph.constant(r.inputs[0]) is not None for r in picked)


def _is_mask(seen: Read) -> bool:
    """Whether it is a float matrix that multiplies a softmax (perhaps plus a constant)."""

    def is_softmax(reference: str) -> bool:
        made = seen.graph.producer(reference)
        added = made.inputs if traits(made).name == "Add" else ()
        return any(n.op == "Softmax" for n in (made, *map(seen.graph.producer, added)))

    if placeholder_rank(seen.node) != _MATRIX or is_whole(seen.node):
        return False
    readers = downstream(seen.node, seen.consumers, _shows)
    return any(reader.op == "Mul" and any(map(is_softmax, reader.inputs)) for reader in readers)


# ------------------------------------------------------------------ the rules


def _by_name(
    pattern: re.Pattern[str], role: Role, ranks: tuple[int, ...] | None, whose: str
) -> Rule[ScopedInput, Role]:
    def is_called(given: ScopedInput) -> bool:
        rank = placeholder_rank(given.node)
        if not pattern.fullmatch(given.base) or (ranks is not None and rank is not None and rank not in ranks):
            return False
        if role is Role.VISUAL and is_board(given.base, given.node):
            return False
        return role is Role.VECTOR or is_whole(given.node) == (role in _COUNTED)

    return Rule(role, is_called, f"its name and its number of axes are those of {role} in {whose}")


#: What the name says, if rank and dtype do not contradict it.
BY_NAME = tuple(_by_name(*row) for row in INPUT_PATTERNS)

#: Where the name says nothing: shape, and what reads it.
BY_READERS: tuple[Rule[Read, Role], ...] = (
    Rule(
        Role.VISUAL,
        lambda s: _is_image(s) and not is_board(s.node.name, s.node),
        "it has the four axes of a batch of images",
    ),
    Rule(
        Role.VISUAL,
        lambda s: _is_image(s) and highest_colour(s.graph, s.node.name) > 1,
        "all that read it divide it by 255, as bytes of colours",
    ),
    Rule(
        Role.PREV_ACTION,
        lambda s: s.recurrent and s.observed and _is_chosen(s),
        "it is integers of which a one-hot is made, beside an observation and a memory",
    ),
    Rule(
        Role.VECTOR,
        lambda s: (s.declared or not s.observed) and not (s.recurrent and s.observed) and _is_chosen(s),
        "it is integers of which a one-hot is made: a discrete state",
    ),
    Rule(
        Role.PARAMETER,
        _is_chosen,
        "it is integers of which a one-hot is made, beside an observation in a graph that declares no inputs",
    ),
    Rule(Role.VECTOR, _picks_rows, "it is integers that say which row of a table is taken: a class"),
    Rule(
        Role.PARAMETER,
        lambda s: _is_in_rows(s) and looks_like_state(s.node.name),
        "its name is that of a memory, and no output is given back to it",
    ),
    Rule(Role.VECTOR, _is_in_rows, "it is a row of numbers for each agent"),
    Rule(Role.MASKS, _is_mask, "a softmax is multiplied by it"),
    Rule(
        Role.VECTOR,
        lambda s: _has_several(s) and _is_fixed(s.node),
        "it is numbers of fixed lengths for each agent: a row, or a history",
    ),
    Rule(
        Role.ENTITIES,
        lambda s: _has_several(s) and not _is_fixed(s.node),
        "it is rows of numbers for each agent, of no fixed number",
    ),
    Rule(Role.VECTOR, _has_several_axes, "it is numbers along several axes of fixed lengths: a board or a grid"),
    Rule(Role.PARAMETER, always, "no name that is known and nothing that reads it says what it is for"),
)


def _may_be_numbers(seen: Read) -> bool:
    kind = getattr(seen.node.attrs.get("dtype"), "kind", "")
    return placeholder_rank(seen.node) in (2, None) and kind == "f"


#: Where there is no observation yet: the only input that the first of these holds for.
LAST_RESORTS: tuple[Rule[Read, Role], ...] = (
    Rule(Role.VECTOR, _may_be_numbers, "it is the only input that may be rows of numbers, and none is an observation"),
    Rule(
        Role.VECTOR,
        lambda s: s.declared and placeholder_rank(s.node) in (1, 2),
        "it is the only input with an axis for the agents, and none is an observation: a discrete state",
    ),
)


def contradicted_names(given: ScopedInput, role: Role | None) -> tuple[str, ...]:
    """What names say of a placeholder whose rank or dtype contradict them, where none is not contradicted."""
    said = list[str]()
    if any(rule.when(given) for rule in BY_NAME):
        return ()
    for pattern, meant, ranks, whose in INPUT_PATTERNS:
        if not pattern.fullmatch(given.base) or meant == role:
            continue
        rank = placeholder_rank(given.node)
        if ranks is not None and rank is not None and rank not in ranks:
            axes = " or ".join(map(str, ranks))
            said.append(f"its name is that of {meant} in {whose}, which has {axes} axes")
        elif meant is Role.VISUAL and is_board(given.base, given.node):
            said.append(f"its name is that of {meant} in {whose}, which is at least {_LEAST_IMAGE}x{_LEAST_IMAGE}")
        elif meant is not Role.VECTOR and is_whole(given.node) != (meant in _COUNTED):
            kind = "integers" if meant in _COUNTED else "floats"
            said.append(f"its name is that of {meant} in {whose}, which is of {kind}")
    return tuple(said)
