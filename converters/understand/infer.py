"""The signature of a policy, read off its graph: brains, outputs, roles of the placeholders, meaning of the action.

Names are tried first (they are ML-Agents' own), then structure; what neither decides is a parameter, or an error that
lists the candidates. ``action`` is judged by its dtype and ancestors alone, never by its name.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from converters.graph.nodes import Graph, Node, TensorShape, node_of, normal_ref, split_ref
from signatures.errors import NotAPolicyError, SignatureError, UsageError
from signatures.memories import SeparateMemory
from signatures.roles import (
    ACTION_NAMES,
    CANONICAL,
    CONSTANT_NAMES,
    INPUT_PATTERNS,
    INPUT_ROLES,
    LISTED_CONSTANTS,
    OBSERVATIONS,
    OUTPUT_NAMES,
    OUTPUT_ROLES,
    Constant,
    Role,
)

_PLACEHOLDERS = ("Placeholder", "PlaceholderWithDefault")
_MAX_LEAVES = 1024
#: Ops that pass a value on without changing its numbers.
TRANSPARENT = frozenset(
    ("Identity", "StopGradient", "PreventGradient", "Snapshot", "CheckNumerics", "Reshape", "Squeeze", "ExpandDims")
)


@dataclass(frozen=True)
class SourceFacts:
    """What a reader knows of a source beside its graph.

    - ``roles``: placeholders whose role the format says (it goes before names and structure).
    - ``family``, ``algorithm``: where the format tells; else (None) the graph is asked. An empty algorithm: none can be
      told.
    - ``image_layout``: NHWC, or NCHW for torch exports.
    - ``memory_layout``: the memory's parts in order; empty: found from the graph.
    - ``constants``: the ones that are no nodes of the graph.
    - ``distributions``: placeholder → what it is fed, where the format says it.
    - ``outputs``: the nodes that the format declares as outputs, with their roles where it says them; empty: it
      declares none, and any node may be an output.
    - ``rows``: the only number of rows that the source takes, or gets right; None: any.
    - ``notes``: what the user should know of this source.
    - ``labels``: names of observations (by placeholder) and actions, where the source carries them.
    - ``memories``: inputs and outputs of their own that are one memory, in the order in which they are joined.
    """

    roles: Mapping[str, Role] = field(default_factory=dict)
    family: str | None = None
    algorithm: str | None = None
    image_layout: str = "NHWC"
    memory_layout: tuple[str, ...] = ()
    constants: Mapping[str, Constant] = field(default_factory=dict)
    distributions: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    outputs: Mapping[str, Role | None] = field(default_factory=dict)
    rows: int | None = None
    notes: tuple[str, ...] = ()
    labels: Mapping[str, Any] = field(default_factory=dict)
    memories: tuple[SeparateMemory, ...] = ()


@dataclass(frozen=True, slots=True)
class Head:
    """One action of a policy: its name in the source, and its canonical name (hybrid policies have two)."""

    base: str
    name: str

    @property
    def deterministic(self) -> str:
        """The name of the same action without chance."""
        return f"deterministic_{self.name}"


@dataclass(frozen=True, slots=True)
class Brain:
    """One policy of a graph: its scope (``""`` or ``"GoalieBrain/"``) and where its outputs are."""

    scope: str
    #: (output's name in the source, its role, its tensor), in graph order
    outputs: tuple[tuple[str, Role, str], ...]
    constants: Mapping[str, Constant] = field(default_factory=dict)
    #: tensors that nothing reads and that could be outputs too, in a graph whose names say nothing
    left_out: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """The scope without its slash."""
        return self.scope.rstrip("/")

    @property
    def heads(self) -> tuple[Head, ...]:
        """The actions. Beside ``action``, outputs called by kind are duplicates; two kinds without it are a hybrid."""
        bases = [base for base, role, _ in self.outputs if role is Role.ACTION]
        if "action" in bases:
            return (Head("action", "action"),)
        if {"continuous_actions", "discrete_actions"} <= set(bases):
            return (Head("continuous_actions", "continuous_actions"), Head("discrete_actions", "discrete_actions"))
        return (Head(bases[0], "action"),)

    @property
    def canonical(self) -> dict[str, str]:
        """Output's name in the source → canonical name; duplicates of the action are left out."""
        heads = self.heads
        names = {h.base: h.name for h in heads}
        for base, role, _ in self.outputs:
            if role is Role.DETERMINISTIC:
                own = next((h for h in heads if base == f"deterministic_{h.base}"), None)
                if own is not None or base == "deterministic_action":
                    names[base] = heads[0].deterministic if own is None else own.deterministic
            elif role is not Role.ACTION:
                names[base] = CANONICAL.get(role, base)
        return names

    @property
    def roots(self) -> tuple[str, ...]:
        """The tensors that the policy computes."""
        return tuple(reference for _, _, reference in self.outputs)


# ------------------------------------------------------------------ brains and outputs


def find_brains(
    graph: Graph, wanted: Mapping[str, Role] | None = None, declared: Mapping[str, Role | None] | None = None
) -> tuple[Brain, ...]:
    """The policies in a graph, in graph order.

    ``wanted`` (source output name → role, from ``--output``) decides instead of names. ``declared`` are the outputs
    that the format names, with their roles where it knows them. Raises NotAPolicyError when
    there is nothing that depends on a placeholder, SignatureError when several nodes could be the action.
    """
    if wanted:
        return _chosen(graph, wanted, declared)
    fed = _depends_on_input(graph)
    given = {n: role for n, role in (declared or {}).items() if role is not None and n in fed}
    if Role.ACTION in given.values():
        outputs = tuple((n.rsplit("/", 1)[-1], role, n) for n, role in given.items())
        scope = _scope_of(graph, [n for n, role in given.items() if role is Role.ACTION])
        rest = tuple(n for n in declared or () if n in fed - set(given))
        return (Brain(scope, outputs, _constants(graph, scope), rest),)
    if declared:
        fed &= set(declared)
    scopes: dict[str, int] = {}
    for node in graph.nodes:
        scope, _, base = node.name.rpartition("/")
        if base in ACTION_NAMES and node.name in fed and node.op not in _PLACEHOLDERS:
            scopes[f"{scope}/" if scope else ""] = node.name.count("/")
    if scopes:
        depth = min(scopes.values())
        return tuple(_brain(graph, scope, fed) for scope, d in scopes.items() if d == depth)
    return (_unnamed(graph, fed, set(declared or ()), given),)


def _constants(graph: Graph, scope: str) -> dict[str, Constant]:
    found: dict[str, Constant] = {}
    for name in CONSTANT_NAMES:
        node = graph.get(scope + name)
        value = graph.constant(node.name) if node is not None else None
        if value is None or value.dtype.kind not in "iuf" or not np.isfinite(value).all():
            continue
        if value.size == 1:
            number = value.reshape(()).item()
            found[name] = int(number) if float(number).is_integer() else float(number)
        elif name in LISTED_CONSTANTS and 0 < value.size <= _MAX_LEAVES:
            found[name] = [int(number) for number in value.reshape(-1).tolist()]
    return found


def _brain(graph: Graph, scope: str, fed: set[str]) -> Brain:
    outputs = []
    for node in graph.nodes:
        base = node.name[len(scope) :]
        named = node.name.startswith(scope) and base in OUTPUT_NAMES
        if named and node.name in fed and node.op not in _PLACEHOLDERS:
            outputs.append((base, OUTPUT_NAMES[base], node.name))
    return Brain(scope, tuple(outputs), _constants(graph, scope))


def _depends_on_input(graph: Graph) -> set[str]:
    """Names of nodes downstream of a placeholder (parameters included)."""
    fed: set[str] = set()
    for node in graph.nodes:
        if node.op in _PLACEHOLDERS or any(node_of(r) in fed for r in node.inputs):
            fed.add(node.name)
    return fed


def _chosen(graph: Graph, wanted: Mapping[str, Role], declared: Mapping[str, Role | None] | None) -> tuple[Brain, ...]:
    outputs: list[tuple[str, Role, str]] = []
    for name, role in wanted.items():
        node_name, _ = split_ref(name)
        if node_name not in graph:
            raise UsageError(
                f"--output names {name!r}, which is not in the graph",
                why=_close(node_name, [n.name for n in graph.nodes]),
                fix="export-model inspect FILE lists the outputs that were found",
            )
        if role not in OUTPUT_ROLES:
            roles = ", ".join(OUTPUT_ROLES)
            raise UsageError(f"--output {name}={role}: that is not an output's role", fix=f"one of: {roles}")
        outputs.append((node_name.rsplit("/", 1)[-1], role, normal_ref(name)))
    if any(role is Role.ACTION for _, role, _ in outputs):
        scope = _scope_of(graph, [node_of(reference) for _, _, reference in outputs])
        return (Brain(scope, tuple(outputs), _constants(graph, scope)),)
    # Naming one output is enough to say that the rest is where it always is.
    brains = find_brains(graph, declared=declared)
    named = {reference for _, _, reference in outputs}
    owners = [
        max((b for b in brains if o[2].startswith(b.scope)), key=lambda b: len(b.scope), default=brains[0])
        for o in outputs
    ]
    return tuple(
        replace(
            brain,
            outputs=(
                *(o for o, owner in zip(outputs, owners, strict=True) if owner is brain),
                *(o for o in brain.outputs if o[2] not in named),
            ),
        )
        for brain in brains
    )


def _scope_of(graph: Graph, names: Sequence[str]) -> str:
    """The scope of a brain whose outputs are ``names``: the one they share, if a placeholder is in it, too."""
    parents = {name.rpartition("/")[0] for name in names}
    scope = f"{parents.pop()}/" if len(parents) == 1 else "/"
    return scope if any(n.op in _PLACEHOLDERS and n.name.startswith(scope) for n in graph.nodes) else ""


def _close(name: str, names: Sequence[str]) -> str | None:
    import difflib

    near = difflib.get_close_matches(name, names, n=3)
    return f"close to it: {', '.join(near)}" if near else None


def _unnamed(graph: Graph, fed: set[str], declared: set[str], known: Mapping[str, Role]) -> Brain:
    """A graph without a node called ``action``: the one output, or tensor that nothing reads, is the action."""
    read = {node_of(r) for node in graph.nodes for r in node.inputs} - declared
    fed = fed - set(known)
    sinks = [n for n in graph.nodes if n.name not in read and n.name in fed and n.op not in _PLACEHOLDERS]
    if not sinks:
        raise NotAPolicyError(
            "there is no policy in this graph",
            why="no node depends on a placeholder, so nothing is computed from an observation",
            fix="give the frozen graph of the policy, or name its output with --output NAME=action",
        )
    likely = [n for n in sinks if re.search(r"action|policy|^pi$|/pi$", n.name.lower())]
    chosen = sinks if len(sinks) == 1 else likely
    if len(chosen) != 1:
        shown = ", ".join(f"{n.name} ({n.op})" for n in sinks[:8]) + (" …" if len(sinks) > 8 else "")
        raise SignatureError(
            "no policy found: it is not clear which output is the action",
            why=f"no node is called 'action'; candidates are {shown}",
            fix="name them: --output NAME=action (and, if it has them, --output NAME=value_estimate …)",
        )
    node = chosen[0]
    output = (node.name.rsplit("/", 1)[-1], Role.ACTION, node.name)
    others = tuple((name.rsplit("/", 1)[-1], role, name) for name, role in known.items())
    return Brain("", (output, *others), _constants(graph, ""), tuple(n.name for n in sinks if n is not node))


# ------------------------------------------------------------------ inputs


def classify_inputs(
    graph: Graph, brain: Brain, wanted: Mapping[str, Role] | None = None, known: Mapping[str, Role] | None = None
) -> dict[str, Role]:
    """Placeholder name → role, in graph order, for everything upstream of the brain's outputs.

    ``wanted`` comes from ``--input``, ``known`` from the reader. A PlaceholderWithDefault that is neither named there
    nor by ML-Agents is left out: its default is used. Raises SignatureError when no observation can be told.
    """
    upstream = graph.ancestors(brain.roots)
    found = [n for n in graph.nodes if n.op in _PLACEHOLDERS and n.name in upstream]
    inputs = {n.name for n in found}
    others = {n.name for n in graph.nodes if n.op in _PLACEHOLDERS and not n.name.startswith(brain.scope)} - inputs
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
        if override is not None or roles[node.name] is not Role.PARAMETER:
            decided.add(node.name)
        if override is not None and override not in INPUT_ROLES:
            raise UsageError(
                f"--input {node.name}={override}: that is not an input's role", fix=f"one of: {', '.join(INPUT_ROLES)}"
            )
    if wanted:
        name = next(iter(wanted))
        raise UsageError(
            f"--input names {name!r}, which is no input of this policy",
            why=_close(name, [n.name for n in found]) or f"its inputs are {', '.join(n.name for n in found)}",
            fix="export-model inspect FILE lists them",
        )
    _by_structure(graph, found, roles, decided)
    if not any(r in OBSERVATIONS for r in roles.values()):
        names = ", ".join(f"{n.name} {_shape_text(n)}" for n in found) or "none"
        raise SignatureError(
            "no policy found: none of the inputs can be told to be an observation",
            why=f"inputs upstream of the outputs: {names}",
            fix="say what they are: --input NAME=vector_observation, --input NAME=visual_observation, --set NAME=VALUE",
        )
    return roles


def placeholder_rank(node: Node) -> int | None:
    """Number of axes of a placeholder, None if the graph does not say."""
    shape: TensorShape | None = node.attrs.get("shape")
    return None if shape is None or shape.dims is None else len(shape.dims)


def _shape_text(node: Node) -> str:
    shape: TensorShape | None = node.attrs.get("shape")
    dtype = node.attrs.get("dtype", "")
    if shape is None or shape.dims is None:
        return f"({dtype}, unknown shape)"
    return f"({dtype} [{', '.join('?' if d is None else str(d) for d in shape.dims)}])"


def role_by_name(base: str, node: Node) -> Role | None:
    """The role that a placeholder's name says, if its rank and dtype do not contradict it."""
    rank, dtype = placeholder_rank(node), node.attrs.get("dtype")
    for pattern, role, ranks in INPUT_PATTERNS:
        if not pattern.fullmatch(base) or (ranks is not None and rank is not None and rank not in ranks):
            continue
        integer = isinstance(dtype, np.dtype) and dtype.kind in "iu"
        if role in (Role.SEQUENCE_LENGTH, Role.BATCH_SIZE, Role.PREV_ACTION):
            if integer:
                return role
        elif role is Role.VECTOR or not integer:
            return role
    return None


def _by_structure(graph: Graph, found: Sequence[Node], roles: dict[str, Role], decided: set[str]) -> None:
    """Decide placeholders whose names say nothing, from what reads them."""
    consumers = graph.consumers()
    recurrent = Role.MEMORY_IN in roles.values()
    unknown = [n for n in found if n.name in roles and n.name not in decided]
    for node in unknown:
        dtype = node.attrs.get("dtype")
        integer = isinstance(dtype, np.dtype) and dtype.kind in "iu"
        if placeholder_rank(node) == 4 and not integer:
            roles[node.name] = Role.VISUAL
        elif integer and placeholder_rank(node) in (1, 2) and _feeds_one_hot(node, consumers):
            if recurrent and any(r in OBSERVATIONS for r in roles.values()):
                roles[node.name] = Role.PREV_ACTION
            elif not any(r in OBSERVATIONS for r in roles.values()):
                roles[node.name] = Role.VECTOR
        elif placeholder_rank(node) == 2 and not integer and _is_mask(graph, node, consumers):
            roles[node.name] = Role.MASKS
    if any(r in OBSERVATIONS for r in roles.values()):
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


def _reached(node: Node, consumers: Mapping[str, list[Node]], through: Iterable[str]) -> list[Node]:
    """Nodes that read ``node``, looked for behind the ops in ``through``."""
    passed, stack, met = frozenset(through), [node], []
    seen: set[str] = set()
    while stack:
        for reader in consumers[stack.pop().name]:
            if reader.name in seen:
                continue
            seen.add(reader.name)
            met.append(reader)
            if reader.op in passed:
                stack.append(reader)
    return met


def _feeds_one_hot(node: Node, consumers: Mapping[str, list[Node]]) -> bool:
    through = TRANSPARENT | {"Cast", "StridedSlice", "Slice", "Split", "Unpack", "Unstack"}
    return any(r.op == "OneHot" for r in _reached(node, consumers, through))


def _is_mask(graph: Graph, node: Node, consumers: Mapping[str, list[Node]]) -> bool:
    """A float matrix that multiplies a softmax (perhaps plus a constant) is a mask."""
    for reader in _reached(node, consumers, TRANSPARENT | {"StridedSlice", "Slice", "Split"}):
        if reader.op == "Mul" and any(
            "Softmax" in {graph[n].op for n in graph.ancestors([r]) if _near(graph, r, n)} for r in reader.inputs
        ):
            return True
    return False


def _near(graph: Graph, reference: str, name: str) -> bool:
    """Whether ``name`` is the producer of ``reference`` or one Add before it."""
    node = graph.producer(reference)
    names = {node.name}
    if node.op in ("Add", "AddV2"):
        names |= {node_of(r) for r in node.inputs}
    return name in names


# ------------------------------------------------------------------ what the action means


@dataclass(frozen=True, slots=True)
class ActionMeaning:
    """What ``action`` is. ``draws`` are the samplers' logits per branch, ``sizes`` the branch sizes' tensors."""

    role: Role
    #: per branch: the tensor whose last axis is the branch (logits, log-probabilities or scores)
    branches: tuple[str, ...] = ()
    #: per branch: the sampler node, for sampled actions
    samplers: tuple[str, ...] = ()


def action_meaning(graph: Graph, reference: str, dtype: np.dtype, has_masks: bool) -> ActionMeaning:
    """Decide from dtype and ancestors whether an action is continuous, sampled, log-probabilities or an argmax.

    ``graph`` must be free of loops (after the straighten pass).
    """
    leaves = _leaves(graph, reference)
    producers = [graph.producer(leaf) for leaf in leaves]
    if dtype.kind in "iu":
        if all(p.op == "Multinomial" for p in producers):
            return ActionMeaning(Role.SAMPLED, tuple(p.inputs[0] for p in producers), tuple(p.name for p in producers))
        if all(p.op == "ArgMax" for p in producers):
            return ActionMeaning(Role.DETERMINISTIC, tuple(p.inputs[0] for p in producers))
        return ActionMeaning(Role.DETERMINISTIC)
    if all(p.op in ("Log", "LogSoftmax") for p in producers):
        return ActionMeaning(Role.LOG_PROBS, tuple(leaves))
    if all(p.op == "Softmax" for p in producers):
        return ActionMeaning(Role.PROBS, tuple(leaves))
    if has_masks:
        return ActionMeaning(Role.LOG_PROBS, tuple(leaves))
    return ActionMeaning(Role.CONTINUOUS)


def _leaves(graph: Graph, reference: str) -> list[str]:
    """The tensors that are joined along the last axis to make ``reference``, in order.

    A join of a join of itself doubles with every step; what is made of more than ``_MAX_LEAVES`` is no action with
    branches, and stands for itself.
    """
    leaves: list[str] = []
    stack = [reference]
    while stack:
        if len(leaves) + len(stack) > _MAX_LEAVES:
            return [reference]
        tensor = stack.pop()
        parts = _parts(graph, graph.producer(tensor))
        if parts:
            stack.extend(reversed(parts))
        else:
            leaves.append(tensor)
    return leaves


def _parts(graph: Graph, node: Node) -> Sequence[str]:
    """What a node passes on or joins along the last axis; empty where it computes."""
    if node.op in TRANSPARENT or node.op == "Cast":
        return node.inputs[:1]
    if node.op == "ConcatV2":
        axis = graph.constant(node.inputs[-1])
        if axis is not None and int(axis) in (1, -1):
            return node.inputs[:-1]
    if node.op == "Pack" and node.attrs.get("axis", 0) in (1, -1):
        return node.inputs
    return ()
