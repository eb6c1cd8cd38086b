"""Inputs of which only the number of agents is read: TF-Agents counts ``discount`` and ``step_type``.

An input that the policy looks at says that, too, and nobody has to feed what nothing depends on.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.files.tensorflow_messages import dtype_number, node_def
from export_model.converters.formats.frozen_graph.tensors import constant
from export_model.converters.formats.saved_model.signature import ModelSignature
from export_model.converters.graph.nodes import node_of, normal_ref

_INT32 = np.dtype(np.int32)


def without_counted(definition: Any, signature: ModelSignature) -> ModelSignature:
    """The signature without such inputs, in whose place the GraphDef message reads the length of another, in place."""
    readers: dict[str, list[Any]] = {}
    for node in definition.node:
        for reference in node.input:
            readers.setdefault(node_of(reference), []).append(node)
    given = {normal_ref(t.name) for t in signature.outputs.values()}
    counted: dict[str, list[Any]] = {}
    seen: list[Any] = []
    for key, tensor in signature.inputs.items():
        name, dims = normal_ref(tensor.name), tensor.shape.dims
        ends = [] if name in given else list(_ends(name, readers, given))
        if dims == (None,) and ends and all(n is not None and n.op == "Shape" for n in ends):
            counted[key] = ends
        elif _are_rows(dims) and any(n is None or n.op != "Shape" for n in ends):
            seen.append((key.startswith("1"), tensor))  # 1/… are memories
    if not counted or not seen:
        return signature
    _, other = min(seen, key=lambda entry: entry[0])
    if other.dtype is None:
        return signature
    for shape in (node for ends in counted.values() for node in ends):
        _count(definition, shape, other.name, dtype_number(other.dtype))
    return replace(signature, inputs={k: t for k, t in signature.inputs.items() if k not in counted})


def _are_rows(dims: tuple[int | None, ...] | None) -> bool:
    """Whether a tensor has a row for each agent."""
    return dims is not None and len(dims) > 1 and dims[0] is None


def _ends(name: str, readers: dict[str, list[Any]], given: set[str]) -> Iterator[Any | None]:
    """What reads a tensor, behind Identities; None where the signature gives it."""
    stack, met = [name], {name}
    while stack:
        for reader in readers.get(stack.pop(), ()):
            if reader.op != "Identity":
                yield reader
            elif reader.name in given:
                yield None
            elif reader.name not in met:
                met.add(reader.name)
                stack.append(reader.name)


def _count(definition: Any, shape: Any, other: str, dtype: int) -> None:
    """A Shape of [B] becomes the first number of another tensor's."""
    kind = shape.attr["out_type"].type or dtype_number(_INT32)
    whole = node_def(f"{shape.name}/whole", "Shape", [other], T=dtype, out_type=kind)
    bounds = [
        constant(f"{shape.name}/{name}", np.array([value], np.int32))
        for name, value in (("begin", 0), ("end", 1), ("step", 1))
    ]
    definition.node.extend([whole, *bounds])
    sources = [whole.name, *(b.name for b in bounds)]
    shape.CopyFrom(node_def(shape.name, "StridedSlice", sources, T=kind, Index=dtype_number(_INT32)))
