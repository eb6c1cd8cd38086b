"""``{"steps": [{"name": …, "do": …, "of": […]}, …]}`` to a graph."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.embed import contract_of, facts_of
from export_model.converters.formats.source import ReadOptions, SourceModel
from export_model.converters.formats.steps.lowerings import STEPS
from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.signatures.errors import DamagedFileError

_OPS = {step: op for op, step in reversed(STEPS.items())}


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The one policy of a file; one that this tool wrote is what its contract says. Raises DamagedFileError."""
    editor = Editor(Graph(()))
    try:
        content = json.loads(given.data)
        for step in content["steps"]:
            editor.keep(_node(step, editor))
    except (ValueError, KeyError, TypeError) as error:
        raise DamagedFileError("is not a list of steps", why=str(error), fix="write it again") from error
    graph = editor.graph()
    contract = contract_of(content["contract"]) if "contract" in content else None
    return [SourceModel(graph, (given.path,), facts_of(graph, contract))]


def _node(step: dict[str, Any], editor: Editor) -> Node:
    name, do = str(step["name"]), step["do"]
    if do == "input":
        shape = TensorShape((None, int(step["width"])))
        return Node(name, "Placeholder", attrs={"dtype": np.dtype(np.float32), "shape": shape})
    if do == "numbers":
        return Node(name, "Const", value=np.array(step["numbers"], np.float32))
    if do == "product":
        kernel = editor.const(np.array(step["kernel"], np.float32), f"{name}/kernel")
        return Node(name, "MatMul", (step["of"][0], kernel), {"transpose_a": False, "transpose_b": False})
    return Node(name, _OPS[do], tuple(step["of"]))
