"""Runs small graphs in the real runtimes, through this project's own writers, and says how results differ.

Nothing here imports TensorFlow: each runtime is a child process that is started once and fed many models.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from msgspec.structs import replace

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.children.process import LoadedModel
from export_model.converters.formats.format import Artifact, WriteOptions
from export_model.converters.formats.frozen_graph.encode import encode
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.shapes import Types, infer_types
from export_model.converters.graph.types import BATCH, TensorType, static_shape
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes
from export_model.signatures.code import CodeOptions
from export_model.signatures.contract import Contract, Origin
from export_model.signatures.errors import UnsupportedOpError
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature, TensorSpec

Array = npt.NDArray[Any]

#: |a − b| ≤ ATOL + RTOL·|b|, as the project compares its formats.
ATOL = RTOL = 1e-5
#: TensorFlow.js has neither of the first ones.
NARROWED = {"int64": "int32", "float64": "float32"}


class Runtimes:
    """The runtimes' processes, and a folder for the models they load."""

    def __init__(self, pool: RuntimePool, folder: Path) -> None:
        self._pool = pool
        self._folder = folder
        self._numbers = itertools.count()
        self._known = {info.name: info for info in available_runtimes()}

    def need(self, name: str) -> None:
        """Skip the test, with the command that helps, if a runtime is not installed."""
        if not self._known[name].installed:
            pytest.skip(f"{name} is not here; get it with: {self._known[name].how}")

    def tensorflow(self, graph: Graph, feeds: Mapping[str, Array], fetches: Sequence[str]) -> list[Array]:
        """Tensors of a graph, written in the portable dialect where that has its ops."""
        try:
            message = encode(graph)
        except UnsupportedOpError:
            message = encode(graph, explicit=True)
        return self.tensorflow_message(message, feeds, fetches)

    def tensorflow_message(self, message: Any, feeds: Mapping[str, Array], fetches: Sequence[str]) -> list[Array]:
        """Tensors of a GraphDef."""
        self.need("tensorflow")
        path = self._folder / f"{next(self._numbers)}.pb"
        path.write_bytes(schema.serialise(message))
        model = self._pool.process("tensorflow").load(str(path), kind="graph")
        results = model.run(dict(feeds), list(fetches))
        model.unload()
        return [results[name] for name in fetches]

    def onnx(self, policy: Policy, feeds: Mapping[str, Array], opset: int) -> list[Array]:
        """The outputs of a policy as ONNX, in onnxruntime."""
        self.need("onnxruntime")
        model = self._load("onnxruntime", policy, "onnx", opset)
        names = [s.name for s in policy.signature.outputs]
        results = model.run(dict(feeds), names)
        model.unload()
        return [results[name] for name in names]

    def tfjs(self, backend: str, policy: Policy, feeds: Mapping[str, Array]) -> list[Array]:
        """The outputs of a policy as a TensorFlow.js graph model, on ``tfjs-cpu`` or ``tfjs-wasm``."""
        self.need(backend)
        model = self._load(backend, policy, "tfjs")
        names = [s.name for s in policy.signature.outputs]
        results = model.predict(dict(feeds), names)
        model.unload()
        return [results[name] for name in names]

    def litert(self, runtime: str, policy: Policy, feeds: Mapping[str, Array]) -> list[Array]:
        """The outputs of a policy as a LiteRT model, with XNNPACK (``litert``) or without (``litert-plain``)."""
        self.need(runtime)
        model = self._load(runtime, policy, "litert")
        names = [s.name for s in policy.signature.outputs]
        results = model.run(dict(feeds), names)
        model.unload()
        return [results[name] for name in names]

    def program(
        self, key: str, policy: Policy, feeds: Mapping[str, Array], code: CodeOptions | None = None
    ) -> list[Array]:
        """The outputs of a policy as source code of a format, compiled where that needs it."""
        (runtime,) = WRITTEN[key].runtimes
        self.need(runtime)
        artifact = program_of(key, policy, code or CodeOptions())
        root = self._folder / str(next(self._numbers))
        artifact.write(root)
        model = self._pool.process(runtime).load(str(root / artifact.main), kind="graph", format=key, seed=1)
        names = [s.name for s in policy.signature.outputs]
        results = model.run(dict(feeds), names)
        model.unload()
        return [results[name] for name in names]

    def _load(self, runtime: str, policy: Policy, target: str, opset: int = 15) -> LoadedModel:
        artifact = WRITTEN[target].artifact(policy, WriteOptions('{"tool": {"version": "test"}}', opset))
        root = self._folder / str(next(self._numbers))
        artifact.write(root)
        return self._pool.process(runtime).load(str(root / artifact.main), kind=target)


def policy_of(graph: Graph, fetches: Sequence[str]) -> Policy:
    """A graph as a policy, for the writers: its placeholders are the inputs, ``y0``, ``y1``… the outputs."""
    names = [f"y{i}" for i in range(len(fetches))]
    graph = Graph((*graph.nodes, *(Node(n, "Identity", (r,)) for n, r in zip(names, fetches, strict=True))))
    types = infer_types(graph)
    inputs = [_spec(n.name, types) for n in graph.nodes if n.op == "Placeholder"]
    outputs = [_spec(n, types) for n in names]
    signature = PolicySignature(inputs=tuple(inputs), outputs=tuple(outputs), family="test", action_space="continuous")
    return Policy("sample", graph, signature, {s.name: s.name for s in inputs}, {n: n for n in names})


def program_of(key: str, policy: Policy, code: CodeOptions) -> Artifact:
    """A policy as source code of a format, whatever its inputs are called. Raises UnsupportedOpError."""
    inputs = tuple(replace(s, role=Role.PARAMETER) for s in policy.signature.inputs)
    signature = replace(policy.signature, inputs=inputs)
    tool = {"name": "export-model", "version": "test", "code": code.to_dict()}
    contract = Contract(policy.name, signature, Origin("test", "0" * 64), policy.source, tool)
    how = WriteOptions(contract.compact(), code=code)
    return WRITTEN[key].artifact(replace(policy, signature=signature), how)


def _spec(name: str, types: Types) -> TensorSpec:
    return TensorSpec(name, Role.OTHER, types[name].dtype.name, static_shape(types[name].shape) or ())


def difference(
    expected: Array, actual: Array, *, narrowed: bool = False, atol: float = ATOL, rtol: float = RTOL
) -> str | None:
    """What is wrong with ``actual``, or None."""
    wanted = NARROWED.get(expected.dtype.name, expected.dtype.name) if narrowed else expected.dtype.name
    if actual.dtype.name != wanted:
        return f"dtype {actual.dtype.name} instead of {wanted}"
    if actual.shape != expected.shape:
        return f"shape {actual.shape} instead of {expected.shape}"
    if np.allclose(actual.astype(np.float64), expected.astype(np.float64), rtol=rtol, atol=atol, equal_nan=True):
        return None
    with np.printoptions(threshold=40, precision=8):
        return f"values {actual.tolist()!s:.300} instead of {expected.tolist()!s:.300}"


class Bindings:
    """Which lengths the symbols of inferred shapes stand for in one run."""

    def __init__(self) -> None:
        self.lengths: dict[str, int] = {}

    def problems(self, name: str, kind: TensorType, real: Array) -> Iterator[str]:
        """What an inferred type says that the real array contradicts."""
        if kind.dtype != real.dtype:
            yield f"{name}: inferred {kind.dtype}, is {real.dtype}"
        if kind.shape is None:
            return
        if len(kind.shape) != real.ndim:
            yield f"{name}: inferred {kind.shape}, is {real.shape}"
            return
        for said, length in zip(kind.shape, real.shape, strict=True):
            if self._length(said, length) != length:
                yield f"{name}: inferred {kind.shape} with {self.lengths}, is {real.shape}"
        if kind.value is None:
            return
        if kind.value.shape != real.shape:
            yield f"{name}: the known value has shape {kind.value.shape}, the real one {real.shape}"
            return
        for said, value in zip(kind.value.reshape(-1).tolist(), real.reshape(-1).tolist(), strict=True):
            known = self._length(said, value) if isinstance(said, str) else said
            if known != value and not (known != known and value != value):
                yield f"{name}: known to be {kind.value.tolist()} with {self.lengths}, is {real.tolist()}"

    def _length(self, said: int | str, length: int) -> int:
        return self.lengths.setdefault(said, length) if isinstance(said, str) else said


def fitting(graph: Graph, name: str, feeds: Mapping[str, Array], batch: int) -> list[str]:
    """What the type inferred for a tensor says that its value contradicts."""
    bound = Bindings()
    bound.lengths[BATCH] = batch
    return list(bound.problems(name, infer_types(graph)[name], run_graph(graph, feeds, [name])[name]))
