"""Models of one operator, made by hand, and what LiteRT and ours answer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.litert.flatbuffer import Table, encode
from export_model.converters.formats.litert.reader import read_litert
from export_model.converters.formats.litert.schema import BUILTINS, OPTIONS, TYPES
from export_model.converters.graph.run import run_graph

interpreter = pytest.importorskip("ai_edge_litert.interpreter", reason="pip install 'export-model[litert]'")

#: The first versions that LiteRT has of operators that had none before.
VERSIONS = {"BROADCAST_TO": 2}


def model_of(
    kind: str,
    inputs: Sequence[np.ndarray],
    results: Sequence[str] = ("float32",),
    fed: int = 1,
    first: int = 0,
    **options: Any,
) -> Table:
    """A model of one operator; ``fed`` operands from ``first`` on are inputs of the model, the others constants."""
    given = range(first, first + fed)
    buffers: list[Table] = [{}]
    tensors: list[Table] = []
    for number, array in enumerate(inputs):
        tensor: Table = {"type": TYPES[array.dtype][0], "name": f"in{number}", "shape": list(array.shape)}
        if number not in given:
            tensor["buffer"] = len(buffers)
            buffers.append({"data": array})
        tensors.append(tensor)
    tensors += [{"type": TYPES[np.dtype(r)][0], "name": f"out{i}"} for i, r in enumerate(results)]
    outputs = [len(inputs) + i for i in range(len(results))]
    operator: Table = {"inputs": [*range(len(inputs))], "outputs": outputs}
    builtin = BUILTINS[kind]
    if builtin.options:
        operator |= {"builtin_options_type": OPTIONS[builtin.options], "builtin_options": options}
    code = {
        "deprecated_builtin_code": min(builtin.code, 127),
        "builtin_code": builtin.code,
        "version": VERSIONS.get(kind, 1),
    }
    return {
        "version": 3,
        "operator_codes": [code],
        "subgraphs": [{"tensors": tensors, "inputs": [*given], "outputs": outputs, "operators": [operator]}],
        "buffers": buffers,
    }


def graph_of(model: Table) -> Any:
    return read_litert(encode(model).to_bytes()).graph


def answers(model: Table, feeds: Sequence[np.ndarray], first: int = 0) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """(what the numpy kernels make of the graph that is read, what LiteRT's own make of the file)."""
    data = encode(model).to_bytes()
    runner = interpreter.Interpreter(
        model_content=data,
        experimental_op_resolver_type=interpreter.OpResolverType.BUILTIN_WITHOUT_DEFAULT_DELEGATES,
    )
    runner.allocate_tensors()
    for details, array in zip(runner.get_input_details(), feeds, strict=True):
        runner.set_tensor(details["index"], array)
    runner.invoke()
    theirs = [runner.get_tensor(d["index"]) for d in runner.get_output_details()]
    found = read_litert(data)
    from export_model.converters.compiler.passes.normalise import normalise

    names = [t.name for t in found.signature.outputs.values()]
    graph = normalise(found.graph, [n.split(":")[0] for n in names])
    given = {f"in{i}": array for i, array in enumerate(feeds, first)}
    ours = run_graph(graph, given, names)
    return [ours[n] for n in names], theirs


def floats(*shape: int) -> np.ndarray:
    draw = np.random.default_rng(sum(shape))
    return np.asarray(draw.standard_normal(shape) * 3, np.float32)


def ints(*numbers: int) -> np.ndarray:
    return np.array(numbers, np.int32)


X, IMAGE = floats(3, 4), floats(2, 6, 6, 3)
