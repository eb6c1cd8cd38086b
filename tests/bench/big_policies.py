"""Policies of any size, for measuring: ``python -m tests.bench.big_policies KIND MEGABYTES FILE``.

A dense policy of ML-Agents' names: layers of equal width behind an observation of 64 numbers, their weights a few
random rows over and over (no two layers are equal). ``frozen`` is a GraphDef,
``onnx`` a model as PyTorch exports it (``Gemm`` with transposed weights, in one file), ``external`` the same with its
weights in a file beside it.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

OBSERVED, ACTIONS = 64, 4
#: Numbers of the largest layer: as many as a tensor of a policy may have.
_WIDEST = 8192


def layers(megabytes: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(kernel [in, out], bias) of each layer; together about as large as asked for."""
    numbers = megabytes * 1e6 / 4
    count = max(2, round(numbers / _WIDEST**2))
    width = min(_WIDEST, round((numbers / count) ** 0.5))
    for index, (rows, columns) in enumerate([(OBSERVED, width), *[(width, width)] * count, (width, ACTIONS)]):
        random = np.random.default_rng((index, rows, columns))
        some = random.standard_normal((min(rows, 97), columns), np.float32) / np.float32(rows**0.5)
        yield np.resize(some, (rows, columns)), random.standard_normal(columns, np.float32)


def frozen(megabytes: float, path: Path) -> None:
    """A frozen graph."""
    from export_model.converters.files import tensorflow_messages as schema
    from tests.handmade import constant, node, placeholder

    graph = schema.GraphDef()
    graph.node.append(placeholder("vector_observation", (None, OBSERVED)))
    value = "vector_observation"
    for index, (kernel, bias) in enumerate(layers(megabytes)):
        name = f"hidden_{index}"
        graph.node.append(constant(f"{name}/kernel", kernel))
        graph.node.append(constant(f"{name}/bias", bias))
        product = node(f"{name}/MatMul", "MatMul", value, f"{name}/kernel", transpose_a=False, transpose_b=False)
        graph.node.append(product)
        graph.node.append(node(f"{name}/BiasAdd", "BiasAdd", f"{name}/MatMul", f"{name}/bias"))
        value = f"{name}/BiasAdd"
        if kernel.shape[1] != ACTIONS:
            graph.node.append(node(f"{name}/Tanh", "Tanh", value))
            value = f"{name}/Tanh"
    graph.node.append(node("action", "Identity", value))
    path.write_bytes(graph.SerializeToString())


def onnx(megabytes: float, path: Path, *, external: bool = False) -> None:
    """An ONNX model as PyTorch writes it."""
    import onnx
    from onnx import TensorProto, helper

    nodes: list[Any] = []
    tensors: list[Any] = []
    value, at = "vector_observation", 0
    beside = path.with_name(f"{path.name}.data")
    with beside.open("wb") if external else io.BytesIO() as data:
        for index, (kernel, bias) in enumerate(layers(megabytes)):
            for name, array in ((f"{index}.weight", np.ascontiguousarray(kernel.T)), (f"{index}.bias", bias)):
                tensor = TensorProto(name=name, data_type=TensorProto.FLOAT, dims=array.shape)
                if external:
                    tensor.data_location = TensorProto.EXTERNAL
                    for key, said in (("location", beside.name), ("offset", at), ("length", array.nbytes)):
                        tensor.external_data.add(key=key, value=str(said))
                    at += data.write(array.data)
                else:
                    tensor.raw_data = array.tobytes()
                tensors.append(tensor)
            last = kernel.shape[1] == ACTIONS
            made = "action" if last else f"gemm_{index}"
            nodes.append(helper.make_node("Gemm", [value, f"{index}.weight", f"{index}.bias"], [made], transB=1))
            value = f"tanh_{index}"
            if not last:
                nodes.append(helper.make_node("Tanh", [made], [value]))
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("vector_observation", TensorProto.FLOAT, ["batch", OBSERVED])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["batch", ACTIONS])],
        tensors,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], producer_name="pytorch")
    model.ir_version = 7
    onnx.save(model, str(path))


def external(megabytes: float, path: Path) -> None:
    """An ONNX model whose weights lie in a file beside it."""
    onnx(megabytes, path, external=True)


KINDS = {"frozen": frozen, "onnx": onnx, "external": external}

if __name__ == "__main__":
    kind, size, place = sys.argv[1:]
    KINDS[kind](float(size), Path(place))
