"""Frozen graphs made by hand, node by node: the smallest policies, and whatever is wrong with them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.frozen_graph.tensors import from_array
from export_model.converters.graph.nodes import TensorShape

Array = npt.NDArray[Any]
NodeDef = Any
Shape = Sequence[int | None] | None


def node(name: str, op: str, *inputs: str, **attributes: Any) -> NodeDef:
    """A node of any op. Attributes by their Python type; a tuple is a list of integers or dtypes."""
    made = schema.NodeDef(name=name, op=op)
    made.input.extend(inputs)
    for key, value in attributes.items():
        _set(made.attr[key], value)
    return made


def _set(attribute: Any, value: Any) -> None:
    if isinstance(value, bool):
        attribute.b = value
    elif isinstance(value, int):
        attribute.i = value
    elif isinstance(value, float):
        attribute.f = value
    elif isinstance(value, str):
        attribute.s = value.encode()
    elif isinstance(value, tuple) and value and isinstance(value[0], type):
        attribute.list.type.extend(schema.dtype_number(np.dtype(v)) for v in value)
    elif isinstance(value, tuple):
        attribute.list.i.extend(value)
    elif isinstance(value, TensorShape):
        _set_shape(attribute.shape, value.dims)
    else:
        attribute.type = schema.dtype_number(np.dtype(value))


def _set_shape(shape: Any, dims: Shape) -> None:
    shape.SetInParent()
    shape.unknown_rank = dims is None
    for size in dims or ():
        shape.dim.add(size=-1 if size is None else size)


def placeholder(name: str, shape: Shape = (None, 3), dtype: Any = np.float32) -> NodeDef:
    """An input; ``shape`` None is an unknown rank."""
    return node(name, "Placeholder", dtype=dtype, shape=TensorShape(None if shape is None else tuple(shape)))


def constant(name: str, value: Any, dtype: Any = None) -> NodeDef:
    """A constant; plain Python floats become float32 and integers int32."""
    array = np.asarray(value, dtype)
    if dtype is None and array.dtype.kind in "if":
        array = array.astype(np.float32 if array.dtype.kind == "f" else np.int32)
    made = node(name, "Const", dtype=array.dtype)
    made.attr["value"].tensor.CopyFrom(from_array(array))
    return made


def weights(rows: int, columns: int, seed: int = 0) -> Array:
    """A kernel that is not constant anywhere."""
    return np.random.default_rng((seed, rows, columns)).standard_normal((rows, columns)).astype(np.float32)


def dense(name: str, source: str, rows: int, columns: int) -> list[NodeDef]:
    """MatMul with a bias; the result is called ``name``."""
    return [
        constant(f"{name}/kernel", weights(rows, columns)),
        constant(f"{name}/bias", np.linspace(-1, 1, columns, dtype=np.float32)),
        node(f"{name}/MatMul", "MatMul", source, f"{name}/kernel", transpose_a=False, transpose_b=False),
        node(name, "BiasAdd", f"{name}/MatMul", f"{name}/bias"),
    ]


def continuous_policy(scope: str = "", observation: str = "vector_observation", actions: int = 2) -> list[NodeDef]:
    """``action`` = tanh of a dense layer."""
    return [
        placeholder(f"{scope}{observation}"),
        *dense(f"{scope}mu", f"{scope}{observation}", 3, actions),
        node(f"{scope}action", "Tanh", f"{scope}mu"),
    ]


def sampled_policy(scope: str = "", actions: int = 3) -> list[NodeDef]:
    """``action`` = a draw from the softmax of a dense layer, as in 0.1 to 0.5."""
    return [
        placeholder(f"{scope}vector_observation"),
        *dense(f"{scope}logits", f"{scope}vector_observation", 3, actions),
        constant(f"{scope}one", 1),
        node(f"{scope}draw", "Multinomial", f"{scope}logits", f"{scope}one", output_dtype=np.int64, seed=1, seed2=2),
        node(f"{scope}action", "Identity", f"{scope}draw"),
    ]


def graph_def(nodes: Iterable[NodeDef], producer: int = 0) -> Any:
    """A GraphDef message."""
    message = schema.GraphDef()
    for each in nodes:
        message.node.add().CopyFrom(each)
    if producer:
        message.versions.producer = producer
    return message


def graph_bytes(nodes: Iterable[NodeDef], producer: int = 0) -> bytes:
    """A frozen graph as training writes it (without ``versions``, unless a producer is given)."""
    return schema.serialise(graph_def(nodes, producer))
