"""Roles of a policy's placeholders: by their names, by what the reader knows, by what reads them.

What is not decided is a parameter, or an error that lists the candidates.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from converters.graph.nodes import Graph, Node, downstream, node_of
from converters.graph.ops.table import is_fed, passes_on, traits
from converters.policy.brains import Brain, close_names
from converters.policy.memories import looks_like_state
from converters.policy.observations import highest_colour
from signatures.errors import SignatureError, UsageError
from signatures.roles import INPUT_PATTERNS, INPUT_ROLES, OBSERVATIONS, Role

#: Names of cameras: ML-Agents' own, and words that say so.
_CAMERA = re.compile(r"^obs_\d+$|^observation_\d+$|visual|camera|image|pixel|rgb|screen|frame")
_LEAST_IMAGE = 20


def classify_inputs(
    graph: Graph,
    brain: Brain,
    wanted: Mapping[str, Role] | None = None,
    known: Mapping[str, Role] | None = None,
    *,
    declared: bool = False,
) -> dict[str, Role]:
    """Placeholder name → role, in graph order, for everything upstream of the brain's outputs.

    ``wanted`` comes from ``--input``, ``known`` from the reader; ``declared``: the format says what its inputs are, so
    that numbers with the batch axis are observations (a graph's placeholders may be parameters of the trainer). A
    PlaceholderWithDefault that is neither named there nor by ML-Agents is left out: its default is used. Raises
    SignatureError when no observation can be told.
    """
    upstream = graph.ancestors(brain.roots)
    found = [n for n in graph.nodes if is_fed(n) and n.name in upstream]
    inputs = {n.name for n in found}
    others = {n.name for n in graph.nodes if is_fed(n) and not n.name.startswith(brain.scope)} - inputs
    wanted = {name: role for name, role in (wanted or {}).items() if node_of(name) not in others}
    roles: dict[str, Role] = {}
    decided: set[str] = set()
    for node in found:
        base = node.name[len(brain.scope) :] if node.name.startswith(brain.scope) else node.name
        override = next((wanted.pop(k) for k in (node.name, f"{node.name}:0", base) if k in wanted), None)
        role = override or (known or {}).get(node.name) or role_by_name(base, node)
        if role is None and node.op == "PlaceholderWithDefault":
            continue
        roles[node.name] = role or Role.PARAMETER
        if override is not None or node.name in (known or {}) or roles[node.name] is not Role.PARAMETER:
            decided.add(node.name)
        if override is not None and override not in INPUT_ROLES:
            raise UsageError(
                f"--input {node.name}={override}: that is not an input's role", fix=f"one of: {', '.join(INPUT_ROLES)}"
            )
    if wanted:
        name = next(iter(wanted))
        raise UsageError(
            f"--input names {name!r}, which is no input of this policy",
            why=close_names(name, [n.name for n in found]) or f"its inputs are {', '.join(n.name for n in found)}",
            fix="export-model inspect FILE lists them",
        )
    _by_structure(graph, found, roles, decided, declared=declared)
    if not any(r in OBSERVATIONS for r in roles.values()):
        names = ", ".join(f"{n.name} {_shape_text(n)}" for n in found) or "none"
        turned = next((n.name for n in found if _has_time_first(n)), None)
        if turned is not None:
            raise SignatureError(
                f"the agents' axis of the input {turned!r} is its second",
                why=f"it is {names}: a history with time first; rows of a policy's inputs are agents",
                fix="export the model with the agents' axis first ([B, T, n]: batch_first=True)",
            )
        raise SignatureError(
            "no policy found: none of the inputs can be told to be an observation",
            why=f"inputs upstream of the outputs: {names}",
            fix="say what they are: --input NAME=vector_observation, --input NAME=visual_observation, --set NAME=VALUE",
        )
    return roles


def placeholder_rank(node: Node) -> int | None:
    """Number of axes of a placeholder, None if the graph does not say."""
    return None if node.dims is None else len(node.dims)


def _shape_text(node: Node) -> str:
    dims, dtype = node.dims, node.attrs.get("dtype", "")
    if dims is None:
        return f"({dtype}, unknown shape)"
    return f"({dtype} [{', '.join('?' if d is None else str(d) for d in dims)}])"


def role_by_name(base: str, node: Node) -> Role | None:
    """The role that a placeholder's name says, if its rank and dtype do not contradict it."""
    rank, dtype = placeholder_rank(node), node.attrs.get("dtype")
    for pattern, role, ranks in INPUT_PATTERNS:
        if not pattern.fullmatch(base) or (ranks is not None and rank is not None and rank not in ranks):
            continue
        integer = isinstance(dtype, np.dtype) and dtype.kind in "iu"
        if role is Role.VISUAL and is_board(base, node):
            continue
        if role in (Role.SEQUENCE_LENGTH, Role.BATCH_SIZE, Role.PREV_ACTION):
            if integer:
                return role
        elif role is Role.VECTOR or not integer:
            return role
    return None


def _by_structure(
    graph: Graph, found: Sequence[Node], roles: dict[str, Role], decided: set[str], *, declared: bool
) -> None:
    """Decide placeholders whose names say nothing, from what reads them."""
    consumers = graph.consumers()
    recurrent = Role.MEMORY_IN in roles.values()
    unknown = [n for n in found if n.name in roles and n.name not in decided]
    for node in unknown:
        dtype = node.attrs.get("dtype")
        integer = isinstance(dtype, np.dtype) and dtype.kind in "iu"
        camera = placeholder_rank(node) == 4 and (not integer or dtype == np.uint8)
        if camera and (not is_board(node.name, node) or highest_colour(graph, node.name) > 1):
            roles[node.name] = Role.VISUAL
        elif integer and placeholder_rank(node) in (1, 2) and _feeds_one_hot(node, consumers):
            if recurrent and any(r in OBSERVATIONS for r in roles.values()):
                roles[node.name] = Role.PREV_ACTION
            elif declared or not any(r in OBSERVATIONS for r in roles.values()):
                roles[node.name] = Role.VECTOR
        elif declared and integer and not recurrent and _is_free(node) and _feeds_table(graph, node, consumers):
            roles[node.name] = Role.VECTOR  # a class, by the row of an embedding
        elif declared and not integer and not recurrent and _is_free(node) and placeholder_rank(node) == 2:
            roles[node.name] = Role.PARAMETER if looks_like_state(node.name) else Role.VECTOR
        elif placeholder_rank(node) == 2 and not integer and _is_mask(graph, node, consumers):
            roles[node.name] = Role.MASKS
        elif declared and _has_rows(node) and not integer and not looks_like_state(node.name):
            roles[node.name] = Role.VECTOR if _is_fixed(node) else Role.ENTITIES
        elif declared and _is_fixed(node) and (placeholder_rank(node) or 0) > 2 and not looks_like_state(node.name):
            roles[node.name] = Role.VECTOR  # a board
    if any(r in OBSERVATIONS for r in roles.values()):
        open_roles = [n for n in unknown if roles[n.name] is Role.PARAMETER and _is_free(n)]
        if declared and not recurrent and open_roles:
            raise _undecided(open_roles)
        return
    floats = [
        n
        for n in unknown
        if roles[n.name] is Role.PARAMETER
        and placeholder_rank(n) in (2, None)
        and getattr(n.attrs.get("dtype"), "kind", "") == "f"
    ]
    if len(floats) == 1:
        roles[floats[0].name] = Role.VECTOR
    numbered = [n for n in unknown if declared and roles[n.name] is Role.PARAMETER and placeholder_rank(n) in (1, 2)]
    if not floats and len(numbered) == 1:  # a discrete state, given as its number
        roles[numbered[0].name] = Role.VECTOR


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


def _has_time_first(node: Node) -> bool:
    """Whether a placeholder is [T, B, n]."""
    dims = node.dims or ()
    return len(dims) == 3 and dims[1] is None and None not in (dims[0], dims[2])


def _has_rows(node: Node) -> bool:
    """Whether a placeholder is [B, n] or [B, T, n]; a single number a row may be a flag that resets the memory."""
    dims = node.dims or ()
    return len(dims) in (2, 3) and dims[0] is None and dims[-1] is not None and (dims[-1] > 1 or len(dims) > 2)


def _undecided(nodes: Sequence[Node]) -> SignatureError:
    name = nodes[0].name
    roles = [f"--input {name}={r}" for r in ("masks", "vector_observation", "parameter")]
    known = ", ".join(roles[placeholder_rank(nodes[0]) != 2 :])
    return SignatureError(
        f"it is not clear what the input {name!r} is for",
        why=f"each agent has its own, beside an observation: {', '.join(f'{n.name} {_shape_text(n)}' for n in nodes)}",
        fix=f"say what it is: {known}, or --set {name}=VALUE",
    )


def _is_free(node: Node) -> bool:
    """Whether the first axis of a placeholder is that of the agents, and it is [B] or [B, n]."""
    dims = node.dims or ()
    return len(dims) in (1, 2) and dims[0] is None


def _feeds_table(graph: Graph, node: Node, consumers: Mapping[str, list[Node]]) -> bool:
    """Whether a tensor says which rows of a constant are taken."""
    readers = downstream(node, consumers, lambda n: _shows(n) or traits(n).elementwise)
    picked = [r for r in readers if traits(r).moves == "pick" and len(r.inputs) > 1]
    return any(graph.constant(r.inputs[0]) is not None for r in picked)


def _shows(node: Node) -> bool:
    """Whether a node passes its operand on, or parts of it."""
    return passes_on(node) or traits(node).moves == "pick"


def _feeds_one_hot(node: Node, consumers: Mapping[str, list[Node]]) -> bool:
    return any(r.op == "OneHot" for r in downstream(node, consumers, lambda n: _shows(n) or n.op == "Cast"))


def _is_mask(graph: Graph, node: Node, consumers: Mapping[str, list[Node]]) -> bool:
    """A float matrix that multiplies a softmax (perhaps plus a constant) is a mask."""

    def is_softmax(reference: str) -> bool:
        made = graph.producer(reference)
        added = made.inputs if traits(made).name == "Add" else ()
        return any(n.op == "Softmax" for n in (made, *map(graph.producer, added)))

    readers = downstream(node, consumers, _shows)
    return any(reader.op == "Mul" and any(map(is_softmax, reader.inputs)) for reader in readers)
