"""Small ONNX models, made here, and how they are run: imported, by the numpy kernels and TensorFlow; in onnxruntime."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import pytest
from onnx import helper, numpy_helper

from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.children.process import LoadedModel
from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.frozen_graph.encode import encode
from export_model.converters.formats.onnx.reader import OnnxModel, read_onnx
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes

Array = npt.NDArray[Any]
Dims = Sequence[int | str]
#: The opsets that are tried: 9 (ML-Agents), 11 and 13 (inputs in place of attributes), 15 (ours), 18 (reductions).
OPSETS = (9, 11, 13, 15, 18)
_IR = {7: 3, 9: 4, 11: 6, 13: 7, 15: 8, 17: 8, 16: 8, 18: 8, 19: 9, 20: 9, 21: 10}


def node(kind: str, inputs: Sequence[str], outputs: Sequence[str] | str = "y", **attributes: Any) -> Any:
    """An ONNX node."""
    names = [outputs] if isinstance(outputs, str) else list(outputs)
    return helper.make_node(kind, list(inputs), names, **attributes)


def constant(name: str, value: Any, dtype: Any = np.float32) -> Any:
    """A Constant node."""
    array = np.asarray(value, dtype)
    return node("Constant", [], name, value=numpy_helper.from_array(array, name))


def declared(name: str, dtype: npt.DTypeLike, dims: Dims | None) -> Any:
    """An input or output."""
    return helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(np.dtype(dtype)), dims)


def model(
    nodes: Sequence[Any],
    inputs: Mapping[str, tuple[npt.DTypeLike, Dims]],
    outputs: Sequence[str] | Mapping[str, tuple[npt.DTypeLike, Dims]] = ("y",),
    constants: Mapping[str, Array] | None = None,
    *,
    opset: int = 15,
    producer: str = "pytorch",
    metadata: Mapping[str, str] | None = None,
    domains: Mapping[str, int] | None = None,
) -> Any:
    """A model; outputs without a type are left to inference."""
    results = (
        [declared(n, *kind) for n, kind in outputs.items()]
        if isinstance(outputs, Mapping)
        else [onnx.ValueInfoProto(name=n) for n in outputs]
    )
    graph = helper.make_graph(
        list(nodes),
        "test",
        [declared(n, *kind) for n, kind in inputs.items()],
        results,
        [numpy_helper.from_array(np.asarray(a), n) for n, a in (constants or {}).items()],
    )
    imports = [helper.make_opsetid("", opset), *(helper.make_opsetid(d, v) for d, v in (domains or {}).items())]
    made = helper.make_model(graph, opset_imports=imports, producer_name=producer, ir_version=_IR.get(opset, 8))
    if metadata:
        helper.set_model_props(made, dict(metadata))
    return made


@dataclass(frozen=True)
class Case:
    """One use of an ONNX op. ``build`` makes the nodes for an opset; ``constants`` may depend on it, too."""

    op: str
    title: str
    build: Callable[[int], Sequence[Any]]
    feeds: Mapping[str, Array]
    constants: Mapping[str, Array] = field(default_factory=dict)
    outputs: Sequence[str] = ("y",)
    opsets: Sequence[int] = OPSETS
    #: shapes that are declared; default: the first axis free, the others as they are fed
    shapes: Mapping[str, Dims] = field(default_factory=dict)
    #: ``onnx``: the reference implementation of the onnx package, for what onnxruntime has not
    oracle: str = "onnxruntime"
    atol: float = 2e-6
    rtol: float = 2e-6

    def model(self, opset: int) -> Any:
        """The case as a model."""
        inputs = {
            name: (array.dtype, self.shapes.get(name, ["batch", *array.shape[1:]] if array.ndim else []))
            for name, array in self.feeds.items()
        }
        return model(self.build(opset), inputs, self.outputs, self.constants, opset=opset)


def save(message: Any, folder: Path, name: str = "model.onnx") -> Path:
    """A model in a file."""
    path = folder / name
    path.write_bytes(message.SerializeToString())
    return path


def imported_graph(path: Path, outputs: Sequence[str]) -> tuple[OnnxModel, Graph, list[str]]:
    """(the model, its graph as the passes begin with it, the nodes that give ``outputs``)."""
    found = read_onnx(Fetched(path))
    assert not found.left_out, found.left_out
    pins = [Node(f"output_{i}", "Identity", (found.outputs[name],)) for i, name in enumerate(outputs)]
    return found, normalise(Graph((*found.graph.nodes, *pins))), [p.name for p in pins]


def imported(path: Path, feeds: Mapping[str, Array], outputs: Sequence[str]) -> list[Array]:
    """The outputs of a model, imported as a graph and run by the numpy kernels; by the model's own names."""
    found, graph, names = imported_graph(path, outputs)
    return answers(found, run_graph(graph, fed(found, feeds), names), names)


def fed(found: OnnxModel, feeds: Mapping[str, Array]) -> dict[str, Array]:
    """The feeds by the graph's names; a model for one agent gets an axis in front."""
    return {found.inputs[n]: a[None] if found.alone else a for n, a in feeds.items()}


def answers(found: OnnxModel, results: Mapping[str, Array], names: Sequence[str]) -> list[Array]:
    """The results as the model itself gives them."""
    return [results[name][0] if found.alone else results[name] for name in names]


def read(message: Any, folder: Path) -> OnnxModel:
    """A model through a file and the reader."""
    return read_onnx(Fetched(save(message, folder)))


class Bench:
    """A folder and the runtimes' processes."""

    def __init__(self, pool: RuntimePool, folder: Path) -> None:
        self.pool = pool
        self.folder = folder
        self._numbers = itertools.count()

    def need(self, runtime: str) -> None:
        """Skip the test, with the command that helps, if a runtime is not installed."""
        info = next(i for i in available_runtimes() if i.name == runtime)
        if not info.installed:
            pytest.skip(f"{runtime} is not here; get it with: {info.how}")

    def place(self, message: Any) -> Path:
        """A model in a file of its own."""
        return save(message, self.folder, f"{next(self._numbers)}.onnx")

    def load(self, path: Path, **options: Any) -> LoadedModel:
        """A model in onnxruntime."""
        return self.pool.process("onnxruntime").load(str(path), **options)

    def tensorflow(self, path: Path, feeds: Mapping[str, Array], outputs: Sequence[str]) -> list[Array]:
        """What TensorFlow makes of the imported graph."""
        found, graph, names = imported_graph(path, outputs)
        file = path.with_suffix(".pb")
        file.write_bytes(schema.serialise(encode(graph.prune([*names, *found.inputs.values()]))))
        loaded = self.pool.process("tensorflow").load(str(file), kind="graph")
        results = loaded.run(fed(found, feeds), names)
        loaded.unload()
        return answers(found, results, names)

    def onnxruntime(self, path: Path, feeds: Mapping[str, Array], outputs: Sequence[str]) -> list[Array]:
        """What onnxruntime makes of the file itself."""
        loaded = self.load(path)
        results = loaded.run(dict(feeds), list(outputs))
        loaded.unload()
        return [results[name] for name in outputs]


def referenced(path: Path, feeds: Mapping[str, Array], outputs: Sequence[str]) -> list[Array]:
    """What the onnx package itself makes of a model."""
    from onnx.reference import ReferenceEvaluator

    results: list[Array] = ReferenceEvaluator(str(path)).run(list(outputs), dict(feeds))
    return results


def rng(seed: int = 0) -> np.random.Generator:
    """A seeded generator."""
    return np.random.default_rng(seed)


def floats(*shape: int, seed: int = 0, scale: float = 1.0) -> Array:
    """Float32 draws of N(0, scale²)."""
    return (rng(seed).standard_normal(shape) * scale).astype(np.float32)
