"""Variables to constants: what TensorFlow's ``convert_variables_to_constants`` does, with a checkpoint's values.

A variable becomes a Const of its own name, what reads it an Identity. Only what an input can reach through is read: the
slots of an optimizer make up most of a checkpoint, and nothing that a policy computes depends on them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.external_data import Detached
from export_model.converters.formats.checkpoint.tensor_bundle import Extents, several
from export_model.converters.formats.checkpoint.training_graph import SavedVariable, TrainingGraph
from export_model.converters.formats.frozen_graph.tensors import constant
from export_model.converters.graph.nodes import Graph, NameScope, Node, node_of, topological
from export_model.converters.graph.ops.table import EFFECTS, VARIABLES, hands_on
from export_model.converters.policy.brains import depends_on_input, find_brains
from export_model.signatures.errors import DamagedFileError, ExportModelError, NotAPolicyError
from export_model.signatures.roles import CONSTANT_NAMES

_IN_A_CHECKPOINT = "it is the graph that training started from; the values are in a checkpoint, and none is next to it"
_GIVE_THAT = "give the checkpoint (model-<step>.cptk.index), or the frozen graph that training wrote when it ended"


class Values(Protocol):
    """Where the values of variables are: a checkpoint, or what a session holds."""

    @property
    def place(self) -> str:
        """What errors call it."""

    def __contains__(self, name: str, /) -> bool: ...

    def read(self, name: str, extents: Extents | None = None, /) -> np.ndarray:
        """The value kept under ``name``, or the part of it that ``extents`` say."""

    def missing(self, keys: Sequence[str], /) -> NotAPolicyError:
        """The error for variables that the policy needs, and that have no value here."""


def is_effect(node: Node) -> bool:
    """Whether a node changes a variable, or writes or reads a checkpoint."""
    return node.op.startswith(EFFECTS)


class Frozen(Struct, frozen=True):
    """A graph with its variables' values, and these by the variables' nodes."""

    graph: Graph
    values: Mapping[str, np.ndarray]


def freeze(
    training: TrainingGraph,
    checkpoint: Values | None,
    roots: Sequence[str] | None = None,
    where: tuple[str, str] = (_IN_A_CHECKPOINT, _GIVE_THAT),
) -> Frozen:
    """The graph with its variables' values.

    Raises NotAPolicyError or DamagedFileError when a variable that the policy needs has no value, or one that does not
    fit. ``checkpoint`` has the values; it is None where there is none: a graph may do without. ``roots`` are the
    policy's outputs; by default they are found by their names. ``where`` says why there may be no values, and the fix.
    """
    graph = training.graph
    variables = {n.name: n for n in graph.nodes if n.op in VARIABLES}
    values: dict[str, np.ndarray] = {}
    missing: dict[str, str] = {}
    for name in wanted_variables(graph):
        place = _place(variables[name], training, checkpoint)
        if checkpoint is None or place is None:
            missing[name] = _key(variables[name], training)
        else:
            values[name] = _fitting_value(variables[name], checkpoint.read(place.key, place.extents), checkpoint)
    frozen = _replace_variables(graph, values)
    if missing:
        needed = frozen.ancestors(_roots(frozen) if roots is None else roots)
        names = [name for name in missing if name in needed]
        if names:
            keys = [missing[n] for n in names]
            raise _without_values(keys, *where) if checkpoint is None else checkpoint.missing(keys)
    return Frozen(frozen, values)


def _roots(graph: Graph) -> list[str]:
    """The policies' outputs; none where no policy is found: the compiler says so, with the candidates."""
    try:
        return [root for brain in find_brains(graph) for root in brain.roots]
    except ExportModelError:
        return []


# ------------------------------------------------------------------ which variables, and where they are


def wanted_variables(graph: Graph) -> list[str]:
    """Variables that something computes with an input from, and ML-Agents' constants."""
    variables = [n.name for n in graph.nodes if n.op in VARIABLES]
    needed = graph.ancestors(sorted(depends_on_input(graph, is_effect)))
    return [n for n in variables if n in needed or n.rpartition("/")[2] in CONSTANT_NAMES]


def _key(node: Node, training: TrainingGraph) -> str:
    saved = training.saved.get(node.name)
    return saved.key if saved is not None else str(node.attrs.get("shared_name") or node.name)


def _place(node: Node, training: TrainingGraph, checkpoint: Values | None) -> SavedVariable | None:
    """Where the checkpoint keeps a variable: the saver's name for it, the name it is shared under, its own."""
    if checkpoint is None:
        return None
    saved = training.saved.get(node.name)
    names = [SavedVariable(str(name)) for name in (node.attrs.get("shared_name"), node.name) if name]
    for place in ([saved] if saved is not None else []) + names:
        if place.key in checkpoint:
            return place
    return None


def _fitting_value(node: Node, value: np.ndarray, checkpoint: Values) -> np.ndarray:
    """The value, if it has the variable's dtype and shape."""
    dtype, dims = node.attrs.get("dtype"), node.dims
    fits = dims is None or (
        len(dims) == value.ndim and all(d is None or d == n for d, n in zip(dims, value.shape, strict=True))
    )
    if not fits or (isinstance(dtype, np.dtype) and dtype != value.dtype):
        raise DamagedFileError(
            f"the variable {node.name!r} is {dtype} {list(dims or ())} in the graph and {value.dtype.name} "
            f"{list(value.shape)} in the checkpoint",
            where=checkpoint.place,
            why="they are of different networks; a later run has overwritten one of them",
            fix="give a checkpoint whose own .meta is there, or another step: --step N",
        )
    return value


def _without_values(keys: Sequence[str], why: str, fix: str) -> NotAPolicyError:
    """The error for a graph that has variables, where nothing has their values."""
    return NotAPolicyError(
        f"the graph has variables and no values for them: {several(keys)}",
        why=why,
        fix=fix,
    )


# ------------------------------------------------------------------ the graph with constants


def _replace_variables(graph: Graph, values: dict[str, np.ndarray]) -> Graph:
    handles = _handles(graph, values)
    scope = NameScope(n.name for n in graph.nodes)
    nodes: list[Node] = []
    for node in graph.nodes:
        if node.name in values:
            node = Node(node.name, "Const", value=values[node.name], origin=node.origin)
        elif node.inputs and node_of(node.inputs[0]) in handles:
            if node.op == "ReadVariableOp":
                node = replace(node, op="Identity", attrs={})
            elif node.op == "ResourceGather":
                axis = Node(scope.fresh(f"{node.name}/axis"), "Const", value=np.array(0, np.int32))
                nodes.append(axis)
                node = replace(node, op="GatherV2", inputs=(*node.inputs, axis.name), attrs={"batch_dims": 0})
            elif node.op == "VariableShape":
                node = replace(node, op="Shape")
        nodes.append(node)
    return Graph(topological(nodes))


def _handles(graph: Graph, values: Collection[str]) -> set[str]:
    """Frozen variables, and what passes them on."""
    found = set(values)
    for node in graph.nodes:
        if hands_on(node) and any(node_of(r) in found for r in node.inputs):
            found.add(node.name)
    return found


def with_values(graph_def: Any, values: Mapping[str, np.ndarray], detached: Detached) -> Any:
    """A GraphDef in which the variables named in ``values`` are constants, and what reads them reads these.

    It is what TensorFlow runs as the original: what ``freeze`` does, done to the GraphDef as it was read, node for
    node, so that what a runtime is given owes nothing to the compiler, and no saver or initialiser has to be run. Large
    values go to ``detached``.
    """
    frozen = schema.GraphDef()
    frozen.versions.CopyFrom(graph_def.versions)
    scope = NameScope(n.name for n in graph_def.node)
    dtypes = _dtypes_of(graph_def, values)
    for node in graph_def.node:
        if node.name in values:
            frozen.node.append(constant(node.name, values[node.name], detached))
            continue
        copy = frozen.node.add()
        copy.CopyFrom(node)
        dtype = dtypes.get(node_of(node.input[0])) if node.input else None
        if dtype is None:
            continue
        if node.op == "ReadVariableOp":
            _become(copy, "Identity", T=dtype)
        elif hands_on(node):
            copy.attr["T"].type = dtype
        elif node.op == "VariableShape":
            copy.op = "Shape"
            copy.attr["T"].type = dtype
        elif node.op == "ResourceGather":
            axis = scope.fresh(f"{node.name}/axis")
            frozen.node.append(constant(axis, np.array(0, np.int32), detached))
            indices = node.attr["Tindices"].type
            _become(copy, "GatherV2", Tparams=dtype, Tindices=indices, Taxis=schema.dtype_number(np.dtype(np.int32)))
            copy.input.insert(2, axis)
    return frozen


def _dtypes_of(graph_def: Any, values: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Frozen variables and what passes them on → their DataType."""
    found = {name: schema.dtype_number(array.dtype) for name, array in values.items()}
    readers: dict[str, list[Any]] = {}
    for node in graph_def.node:
        if hands_on(node):
            for reference in node.input:
                readers.setdefault(node_of(reference), []).append(node)
    stack = list(found)
    while stack:
        name = stack.pop()
        for node in readers.get(name, ()):
            if node.name not in found:
                found[node.name] = found[name]
                stack.append(node.name)
    return found


def _become(node: Any, op: str, **types: int) -> None:
    node.op = op
    node.attr.clear()
    for key, number in types.items():
        node.attr[key].type = number
