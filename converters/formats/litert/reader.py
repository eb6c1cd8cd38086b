"""A .tflite file to a graph: the function that its first signature calls, or (before there were signatures) its first.

Tensors that are made for nothing are left out with the operators that make them; every operator that is left must be
one of the table, and read only what stands before it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from msgspec import Struct

from export_model.converters.compiler.options import MAX_PORTS
from export_model.converters.formats.embed import contract_of
from export_model.converters.formats.litert.artifact import note, operator_of
from export_model.converters.formats.litert.flatbuffer import Table, decode
from export_model.converters.formats.litert.importer.importer import LiteRTImporter
from export_model.converters.formats.litert.importer.table import TABLE
from export_model.converters.formats.litert.schema import VERSION
from export_model.converters.formats.litert.tensors import Tensors, damaged_error, entry_of, needed_operators
from export_model.converters.formats.onnx.tensor_map import TENSORS_KEY, loads
from export_model.converters.formats.saved_model.signature import ModelSignature, TensorInfo
from export_model.converters.graph.builder import MAX_BUILT_NODES
from export_model.converters.graph.nodes import Graph, TensorShape
from export_model.converters.graph.types import INT64
from export_model.signatures.contract import EMBEDDED, Contract
from export_model.signatures.errors import NotAPolicyError

#: The signature that is read where a file has several, as TensorFlow calls the one of a model that is served.
SERVING = "serving_default"
#: What TensorFlow puts in front of the name of an input.
_SERVED = f"{SERVING}_"


class LitertModel(Struct, frozen=True):
    """A file as it was read.

    ``tensors`` and ``ports`` are the numbers of tensors by name, and by what a caller calls them, for who runs the file
    itself; ``function`` is the number of the one that was read.
    """

    graph: Graph
    signature: ModelSignature
    key: str
    tensors: Mapping[str, int]
    ports: Mapping[str, int]
    function: int
    others: tuple[str, ...]
    description: str = ""
    contract: Contract | None = None
    widened: bool = False
    narrowed: bool = False


def read_litert(data: bytes) -> LitertModel:
    """Read a file. Raises DamagedFileError, NotAPolicyError, UnsupportedOpError, GraphError."""
    model = decode(data)
    if model.get("version", 0) != VERSION:
        raise NotAPolicyError(
            f"the .tflite file is of version {model.get('version', 0)} of its format",
            why=f"version {VERSION} is read, which TensorFlow Lite has written since its first release",
            fix="convert the model again",
        )
    named = {str(s.get("signature_key", "")): s for s in reversed(model.get("signature_defs", ()))}
    key = next((k for k in (SERVING, *reversed(named)) if k in named), "")
    called = named.get(key, {})
    subgraph = entry_of(model, "subgraphs", called.get("subgraph_index", 0))
    tensors = Tensors(model, subgraph, len(data))
    inputs, outputs = (_ports(subgraph, called, side, tensors) for side in ("inputs", "outputs"))
    text, stored = note(model, EMBEDDED), None
    contract = None if text is None else contract_of(text)
    if contract is not None:
        views = loads(note(model, TENSORS_KEY) or "").values.values()
        stored = {v.name for v in views if v is not None and v.axes}
        wide = {s.name for s in contract.signature.outputs if np.dtype(s.dtype) == INT64}
        outputs |= {n: _wide(model, subgraph, tensors, outputs[n]) for n in outputs.keys() & wide}
    if not outputs:
        raise NotAPolicyError("the model gives nothing", fix="give the model that training exported")
    operators = needed_operators(subgraph, outputs.values(), inputs.values())
    if len(operators) > MAX_BUILT_NODES:
        raise NotAPolicyError(
            f"the model has {len(operators)} operators",
            why="a policy has some hundreds",
            fix="convert the policy alone",
        )
    importer = LiteRTImporter(tensors, {number: name for name, number in inputs.items()}, stored)
    for operator in operators:
        code = entry_of(model, "operator_codes", operator.get("opcode_index", 0))
        importer.translate(operator, operator_of(code), TABLE)
    for number in outputs.values():
        importer.operand(number)
    graph = importer.graph()

    def side(ports: Mapping[str, int]) -> dict[str, TensorInfo]:
        dims = {n: TensorShape(tensors.dims(n)) for n in ports.values()}
        return {name: TensorInfo(importer.values[n], tensors.dtype(n), dims[n]) for name, n in ports.items()}

    return LitertModel(
        graph=graph,
        signature=ModelSignature(side(inputs), side(outputs), key or None),
        key=key,
        tensors={name: number for number, name in enumerate(tensors.names)},
        ports={**outputs, **inputs},
        function=int(called.get("subgraph_index", 0)),
        others=tuple(k for k in named if k != key),
        description=str(model.get("description", "")),
        contract=contract,
        widened=importer.widened,
        narrowed=importer.narrowed,
    )


def _wide(model: Table, subgraph: Table, tensors: Tensors, number: int) -> int:
    """The tensor of int64 that this tool gave as int32, the number of it (``Subgraph.output``)."""
    for operator in subgraph.get("operators", ()):
        if number in operator.get("outputs", ()) and len(operator.get("inputs", ())) == 1:
            kind = operator_of(entry_of(model, "operator_codes", operator.get("opcode_index", 0)))
            operand = int(operator["inputs"][0])
            if kind == "CAST" and operand != -1 and tensors.dtype(operand) == INT64:
                return operand
    return number


def _ports(subgraph: Table, called: Table, side: str, tensors: Tensors) -> dict[str, int]:
    """Name → number of the tensors that are fed or given. Raises DamagedFileError, NotAPolicyError."""
    named = [(str(e.get("name", "")), int(e.get("tensor_index", 0))) for e in called.get(side, ())]
    listed = [int(i) for i in subgraph.get(side, ())]
    if len(listed) > MAX_PORTS or len(named) > MAX_PORTS:
        raise NotAPolicyError(
            f"the model has {max(len(listed), len(named))} {side}",
            why=f"no more than {MAX_PORTS} are converted; a policy has a few",
            fix="convert the policy alone",
        )
    found: dict[str, int] = {}
    for name, number in named or [("", n) for n in listed]:
        own = tensors.name(number).removeprefix(_SERVED)
        name = name or own.removesuffix(":0")
        if name in found:
            raise damaged_error(f"two {side} are called {name!r}")
        found[name] = number
    return found
