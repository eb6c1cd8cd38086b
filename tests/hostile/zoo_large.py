"""Files of the zoo that ask for more memory or time than they have bytes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.handmade import constant, continuous_policy, node, placeholder
from tests.hostile.making import (
    case,
    frozen,
    onnx_policy,
)


def fixed_batch(rows: int) -> bytes:
    """A model that was exported for so many rows."""
    import onnx

    model = onnx.ModelProto.FromString(onnx_policy())
    for value in (*model.graph.input, *model.graph.output):
        dim = value.type.tensor_type.shape.dim[0]
        dim.Clear()
        dim.dim_value = rows
    data: bytes = model.SerializeToString()
    return data


def _large_onnx() -> None:
    from onnx import helper, numpy_helper

    make = helper.make_node

    def numbers(name: str, value: Any) -> Any:
        return numpy_helper.from_array(np.asarray(value), name)

    def added(nodes: Sequence[Any], *weights: Any, axes: Sequence[int] = (0,)) -> bytes:
        """``big`` summed up and added to the action."""
        ends = [
            make("ReduceSum", ["big", "axes"], ["sum"], keepdims=int(axes != (0,))),
            make("MatMul", ["obs_0", "kernel"], ["product"]),
            make("Add", ["product", "sum"], ["continuous_actions"]),
        ]
        return onnx_policy([*nodes, *ends], [*weights, numbers("axes", np.array(axes, np.int64))])

    one, wide = numbers("one", np.ones(2, np.float32)), np.array([2**31], np.int64)

    def doubled(first: str, axis: int) -> list[Any]:
        names = [first, *(f"twice_{i}" for i in range(31)), "big"]
        return [make("Concat", [a, a], [b], axis=axis) for a, b in itertools.pairwise(names)]

    hot = [make("Cast", ["obs_0"], ["index"], to=7), make("OneHot", ["index", "depth", "values"], ["hot"])]
    hot.append(make("ReduceSum", ["hot", "last"], ["big"], keepdims=0))
    values = [numbers("depth", np.int64(2**31)), numbers("values", np.array([0, 1], np.float32))]
    files = {
        "a fixed batch of 2^31-1": fixed_batch(2**31 - 1),
        "a fixed batch of 2^24": fixed_batch(2**24),
        "a fixed batch of 2^62": fixed_batch(2**62),
        "an Expand to 2^31": added([make("Expand", ["one", "shape"], ["big"])], one, numbers("shape", [2**31, 2])),
        "a Tile to 2^32": added([make("Tile", ["one", "shape"], ["big"])], one, numbers("shape", wide)),
        "a ConstantOfShape of 2^32": added(
            [make("ConstantOfShape", ["shape"], ["big"])], numbers("shape", np.array([2**32], np.int64))
        ),
        "a Pad of 2^31": added(
            [make("Pad", ["obs_0", "pads"], ["big"])], numbers("pads", np.array([0, 0, 0, 2**31], np.int64)), axes=(1,)
        ),
        "a OneHot of depth 2^31": added(hot, *values, numbers("last", np.array([2], np.int64)), axes=(1,)),
        "thirty doublings of the observation": added(doubled("obs_0", 1), axes=(1,)),
        "thirty doublings of a constant": added(doubled("one", 0), one),
    }
    for label, data in files.items():

        def make_file(folder: Path, marker: Path, data: bytes = data) -> Path:
            path = folder / "policy.onnx"
            path.write_bytes(data)
            return path

        case(f"ONNX, {label}")(make_file)


_large_onnx()


@case("ONNX, one file of weights named 3,000 times")
def _(folder: Path, marker: Path) -> Path:
    import onnx

    model = onnx.ModelProto.FromString(onnx_policy())
    (folder / "weights.bin").write_bytes(bytes(4 << 20))
    for i in range(3000):
        tensor = model.graph.initializer.add(name=f"t{i}", data_type=1, dims=[1 << 20], data_location=1)
        for key, value in (("location", "weights.bin"), ("offset", "0"), ("length", str(4 << 20))):
            entry = tensor.external_data.add()
            entry.key, entry.value = key, value
    path = folder / "policy.onnx"
    path.write_bytes(model.SerializeToString())
    return path


def _large_graphs() -> None:
    f32, i32 = {"T": np.float32}, np.int32

    def summed(nodes: Sequence[Any], axes: Any = 0, *, keep: bool = False) -> list[Any]:
        """``big`` summed up and added to the action."""
        policy = continuous_policy()
        next(n for n in policy if n.name == "action").input[0] = "added"
        ends = [
            constant("axes", axes),
            node("sum", "Sum", "big", "axes", keep_dims=keep, Tidx=i32, **f32),
            node("added", "Add", "mu", "sum", **f32),
        ]
        return [*policy, *nodes, *ends]

    def chain(count: int, op: str) -> list[Any]:
        policy = continuous_policy()
        links = [node(f"link_{i}", op, f"link_{i - 1}" if i else "mu") for i in range(count)]
        return [*policy[:-1], *links, node("action", "Tanh", f"link_{count - 1}")]

    count = [constant("a", 0), constant("b", 2**31 - 1), constant("d", 1)]
    hot = [constant("i", [1]), constant("depth", 2**31 - 1), constant("on", 1.0), constant("off", 0.0)]
    graphs: dict[str, Callable[[], list[Any]]] = {
        "a Fill of 2^31-1": lambda: summed(
            [constant("dims", [2**31 - 1]), constant("v", 1.0), node("big", "Fill", "dims", "v", **f32)]
        ),
        "a Tile of the observation": lambda: summed(
            [constant("times", [1, 2**30]), node("big", "Tile", "vector_observation", "times", Tmultiples=i32, **f32)],
            1,
            keep=True,
        ),
        "a Range to 2^31-1": lambda: summed(
            [*count, node("r", "Range", "a", "b", "d", Tidx=i32), node("big", "Cast", "r", SrcT=i32, DstT=np.float32)]
        ),
        "a OneHot of depth 2^31-1": lambda: summed(
            [*hot, node("big", "OneHot", "i", "depth", "on", "off", TI=i32, axis=-1, **f32)], [0, 1]
        ),
        "an observation of 2^31-1": lambda: [
            placeholder("vector_observation", (None, 2**31 - 1)),
            *continuous_policy()[1:],
        ],
        "a chain of 30,000 nodes": lambda: chain(30_000, "Tanh"),
        "a chain of 300,000 nodes": lambda: chain(300_000, "Identity"),
    }
    for label, nodes in graphs.items():

        def make_graph(folder: Path, marker: Path, nodes: Callable[[], list[Any]] = nodes) -> Path:
            return frozen(folder, nodes())

        case(f"frozen graph, {label}")(make_graph)


_large_graphs()
