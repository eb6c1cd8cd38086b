"""A model's own signature (names for its inputs and outputs) put into its graph, so that the compiler sees it.

SavedModels and TensorFlow.js models name tensors by keys; what is called ``action`` by its key may be ``Identity:0`` in
the graph. An output becomes a node of the name that says what it is: its key, if that is a name of ML-Agents; else its
node's own name, if that is; ``action`` where only one is left and none was called so; else its key. What the signature
does not name is no output.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import Struct, field

from export_model.converters.compiler.options import MAX_PORTS
from export_model.converters.files.tensorflow_messages import dtype_number
from export_model.converters.formats.format import Port
from export_model.converters.graph.nodes import (
    Graph,
    NameScope,
    Node,
    TensorShape,
    node_of,
    normal_ref,
    renamed_ref,
    split_ref,
    topological,
)
from export_model.converters.graph.ops.table import is_fed
from export_model.converters.graph.types import Symbols, TensorType
from export_model.converters.policy.action_values import is_q_name
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.policy.inputs import role_by_name
from export_model.converters.policy.memories import float_rows, paired_memories
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.dtypes import DATA_TYPES
from export_model.signatures.errors import DamagedFileError, NotAPolicyError
from export_model.signatures.memories import SeparateMemory
from export_model.signatures.roles import ACTION_NAMES, CANONICAL, CONSTANT_NAMES, OUTPUT_NAMES, Role

_Q_VALUES = CANONICAL[Role.Q_VALUES]
#: TensorFlow's names of dtypes that numpy knows by the same.
_NUMBERS = frozenset(t.dtype.name for t in DATA_TYPES)


class TensorInfo(Struct, frozen=True):
    """One entry of a signature."""

    name: str
    dtype: np.dtype | None = None
    shape: TensorShape = field(default_factory=lambda: TensorShape(None))


class ModelSignature(Struct, frozen=True):
    """Key → tensor of the inputs and of the outputs; ``key`` is what the signature itself is called."""

    inputs: Mapping[str, TensorInfo] = field(default_factory=dict)
    outputs: Mapping[str, TensorInfo] = field(default_factory=dict)
    key: str | None = None

    @property
    def roots(self) -> list[str]:
        """The outputs' references."""
        return [normal_ref(t.name) for t in self.outputs.values()]

    def ports(self) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Inputs and outputs as whoever calls the model must name them."""
        inputs, outputs = (
            tuple(Port(k, None if t.dtype is None else t.dtype.name, t.shape.dims, t.name) for k, t in side.items())
            for side in (self.inputs, self.outputs)
        )
        return inputs, outputs


def signature_of(inputs: Mapping[str, Any], outputs: Mapping[str, Any], key: str) -> ModelSignature:
    """What TensorFlow says of a function that it froze: each tensor's name, dtype, and shape or None."""
    inward, outward = (
        {
            k: TensorInfo(name, _numbers(kind), TensorShape(None if shape is None else tuple(shape)))
            for k, (name, kind, shape) in side.items()
        }
        for side in (inputs, outputs)
    )
    return ModelSignature(inward, outward, key)


def _numbers(kind: str) -> np.dtype | None:
    """The dtype that TensorFlow calls so; None for texts and others that are no numbers."""
    return np.dtype(kind) if kind in _NUMBERS else None


def expose(graph: Graph, signature: ModelSignature) -> tuple[Graph, dict[str, Role]]:
    """(the graph with its outputs under telling names, the roles that the inputs' keys say).

    Raises DamagedFileError where the signature names what the graph does not have.
    """
    if not signature.outputs:
        return graph, {}
    if max(len(signature.inputs), len(signature.outputs)) > MAX_PORTS:
        raise NotAPolicyError(
            f"its signature has {len(signature.inputs)} inputs and {len(signature.outputs)} outputs",
            why=f"no more than {MAX_PORTS} are converted; a policy has a few",
            fix="save the policy alone",
        )
    for key, tensor in (*signature.inputs.items(), *signature.outputs.items()):
        if node_of(tensor.name) not in graph:
            raise DamagedFileError(
                f"the signature's {key!r} is the tensor {tensor.name!r}, which is not in the graph",
                fix="save the model again",
            )
    keep = [n.name for n in graph.nodes if n.name in (*CONSTANT_NAMES, EMBEDDED)]
    graph = _with_placeholders(graph, signature)
    graph = graph.prune([*signature.roots, *keep])
    names = output_names(signature)
    taken = {n.name for n in graph.nodes}
    scope = NameScope((*taken, *names.values(), *_actions(signature)))
    pins: list[Node] = []
    moved: dict[str, str] = {}
    for key, tensor in signature.outputs.items():
        name, reference = names[key], normal_ref(tensor.name)
        if reference == name:
            continue
        if name in taken:
            moved[name] = scope.fresh(f"{name}/inner")
        node, index = graph.producer(reference), split_ref(reference)[1]
        origin = node.origin if index == 0 else f"{node.name}:{index}"
        pins.append(Node(name, "Identity", (reference,), origin=origin))
    roles = {node_of(t.name): role for k, t in signature.inputs.items() if (role := _role(graph, k, t)) is not None}
    joined = [action for action, keys in _actions(signature).items() if len(keys) > 1]
    moved.update({action: scope.fresh(f"{action}/inner") for action in joined if action in taken})
    pins += _several_actions(signature, scope)
    nodes = [*graph.rename(moved).nodes, *(p.with_inputs(renamed_ref(r, moved) for r in p.inputs) for p in pins)]
    return Graph(topological(nodes)), {moved.get(n, n): role for n, role in roles.items()}


def _actions(signature: ModelSignature) -> dict[str, list[str]]:
    """What an action of several parts (TF-Agents: ``action/0``, ``action/jump``) becomes → the keys of its parts.

    Numbers are one action, classes another; empty for other signatures, and for parts that are no rows.
    """
    parts = sorted((k for k in signature.outputs if k.startswith("action/")), key=_natural)
    kinds: dict[str, list[str]] = {}
    for key in parts:
        tensor = signature.outputs[key]
        dims, kind = tensor.shape.dims, "" if tensor.dtype is None else tensor.dtype.kind
        if kind not in ("f", "i") or dims is None or len(dims) not in (1, 2) or None in dims[1:]:
            return {}
        kinds.setdefault("continuous_actions" if kind == "f" else "discrete_actions", []).append(key)
    return {} if len(parts) < 2 or any(k in OUTPUT_NAMES for k in signature.outputs) else kinds


def _natural(key: str) -> list[tuple[int, str]]:
    """Numbers in a key in their order."""
    return [(int(part or 0), "") if i % 2 else (0, part) for i, part in enumerate(re.split(r"(\d{1,9})", key))]


def _several_actions(signature: ModelSignature, scope: NameScope) -> list[Node]:
    """The parts of an action side by side, a row per agent."""
    nodes: list[Node] = []
    names = output_names(signature)

    def const(value: Sequence[int] | int, what: str) -> str:
        nodes.append(Node(scope.fresh(f"action/{what}"), "Const", value=np.array(value, np.int32)))
        return nodes[-1].name

    for action, keys in _actions(signature).items():
        if len(keys) == 1:
            continue  # it is pinned under that name
        columns = []
        kinds = {key: tensor.dtype for key in keys if (tensor := signature.outputs[key]).dtype is not None}
        common = np.result_type(*kinds.values())
        for key in keys:
            dims = signature.outputs[key].shape.dims
            columns.append(names[key])
            if kinds[key] != common:
                nodes.append(Node(scope.fresh("action/cast"), "Cast", (columns[-1],), {"DstT": common}))
                columns[-1] = nodes[-1].name
            if dims is not None and len(dims) == 1:
                fed = (columns[-1], const([-1, 1], "column_shape"))
                nodes.append(Node(scope.fresh("action/column"), "Reshape", fed, {}))
                columns[-1] = nodes[-1].name
        nodes.append(Node(action, "ConcatV2", (*columns, const(1, "axis")), {}))
    return nodes


def declared_outputs(signature: ModelSignature) -> dict[str, Role | None]:
    """The outputs that a signature declares, as they are called once exposed, with the roles that their names say."""
    names, joined = output_names(signature), _actions(signature)
    parts = {names[key] for keys in joined.values() if len(keys) > 1 for key in keys}
    exposed = [*(name for name in names.values() if name not in parts), *joined]
    return {name: OUTPUT_NAMES.get(name.rpartition("/")[2]) for name in exposed}


def expose_signature(graph: Graph, signature: ModelSignature, notes: Sequence[str] = ()) -> tuple[Graph, SourceFacts]:
    """The graph with its outputs under telling names, and what its signature says of it. Raises DamagedFileError."""
    graph, roles = expose(graph, signature)
    memories = memories_of(signature, roles)
    said = (f"{action} is {', '.join(keys)}, in this order" for action, keys in _actions(signature).items())
    return graph, SourceFacts(
        roles=roles, outputs=declared_outputs(signature), memories=memories, notes=(*notes, *said)
    )


def memories_of(signature: ModelSignature, roles: Mapping[str, Role]) -> tuple[SeparateMemory, ...]:
    """The inputs of a signature that are fed what an output gave; it says the shapes of both."""
    inputs = {node_of(t.name): t for t in signature.inputs.values() if node_of(t.name) not in roles}
    names = output_names(signature)
    outputs = {names[k]: t for k, t in signature.outputs.items() if names[k] not in OUTPUT_NAMES}

    def types() -> dict[str, TensorType]:
        free = Symbols()
        return {
            name: TensorType(t.dtype, tuple(free.fresh() if d is None else d for d in t.shape.dims))
            for name, t in (*inputs.items(), *outputs.items())
            if t.dtype is not None and t.shape.dims is not None
        }

    given = {f"state{k[1:]}": node_of(t.name) for k, t in signature.inputs.items() if re.fullmatch(r"1(/.*)?", k)}
    if given and given.keys() <= signature.outputs.keys():  # PolicySaver of TF-Agents: 1/lstm/0 and state/lstm/0
        kinds = types()
        sides = [(n, names[k], float_rows(kinds.get(n)), float_rows(kinds.get(names[k]))) for k, n in given.items()]
        return tuple(SeparateMemory(n, out, a, b) for n, out, a, b in sides if a is not None and b is not None)
    return paired_memories(inputs, outputs, types)


def _with_placeholders(graph: Graph, signature: ModelSignature) -> Graph:
    """An input may be any tensor of the graph; what computes it is then left out."""
    given = {node_of(t.name): t for t in signature.inputs.values() if split_ref(t.name)[1] == 0}
    nodes = []
    for node in graph.nodes:
        tensor = given.get(node.name)
        if tensor is not None and not is_fed(node) and tensor.dtype is not None:
            node = Node(
                node.name, "Placeholder", (), {"dtype": tensor.dtype, "shape": tensor.shape}, origin=node.origin
            )
        nodes.append(node)
    return Graph(tuple(nodes))


def fed_by_signature(graph_def: Any, signature: ModelSignature) -> Any:
    """The same of a GraphDef message, in place: what parses examples, say, is left out before anything is run."""
    given = {node_of(t.name): t for t in signature.inputs.values() if split_ref(t.name)[1] == 0}
    for node in graph_def.node:
        tensor = given.get(node.name)
        if tensor is None or is_fed(node) or tensor.dtype is None:
            continue
        node.op = "Placeholder"
        del node.input[:]
        node.attr.clear()
        node.attr["dtype"].type = dtype_number(tensor.dtype)
    return graph_def


def _role(graph: Graph, key: str, tensor: TensorInfo) -> Role | None:
    node = graph.get(node_of(tensor.name))
    if node is None or split_ref(tensor.name)[1]:
        return None
    return role_by_name(key, node)


def _has_several_columns(tensor: TensorInfo) -> bool:
    """Whether a tensor is floats [B, n], n above 1, as far as the signature says."""
    dims, dtype = tensor.shape.dims, tensor.dtype
    return (dtype is None or dtype.kind == "f") and (dims is None or (len(dims) == 2 and dims[1] != 1))


def output_names(signature: ModelSignature) -> dict[str, str]:
    """Output's key → the node that stands for it, once it is exposed."""
    names = {keys[0]: action for action, keys in _actions(signature).items() if len(keys) == 1}
    left: list[str] = []
    for key, tensor in signature.outputs.items():
        if key in names:
            continue
        node, index = split_ref(normal_ref(tensor.name))
        if key in OUTPUT_NAMES:
            names[key] = key
        elif index == 0 and node.rpartition("/")[2] in OUTPUT_NAMES and node not in names.values():
            names[key] = node
        elif is_q_name(key) and _has_several_columns(tensor) and _Q_VALUES not in {*names.values(), *signature.outputs}:
            names[key] = _Q_VALUES
        else:
            left.append(key)
    acting = {n.rpartition("/")[2] for n in names.values()} & {*ACTION_NAMES, _Q_VALUES}
    if len(left) == 1 and not acting:
        names[left[0]] = "action"
    else:
        scope = NameScope(names.values())
        names.update(
            {key: scope.fresh(re.sub(r"[^A-Za-z0-9_./-]", "_", key).lstrip("/_-") or "output") for key in left}
        )
    return names
