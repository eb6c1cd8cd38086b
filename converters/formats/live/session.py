"""A ``tf.compat.v1.Session``: its graph, frozen with the values that its variables have now.

The graph is not touched: variables are read through tensors that it has, as GraphDef bytes it goes the way of a
checkpoint's graph. The original is the same GraphDef with the values assigned, run by TensorFlow in a child process.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.checkpoint.freeze import freeze, wanted_variables
from export_model.converters.formats.checkpoint.policy_nodes import policy_nodes
from export_model.converters.formats.checkpoint.tensor_bundle import Extents, several
from export_model.converters.formats.checkpoint.training_graph import SavedVariable, TrainingGraph, training_graph
from export_model.converters.formats.live.freeze import flatten_graph
from export_model.converters.formats.source import BUILT_BY_PYTHON, OriginalRun, SourceModel
from export_model.converters.graph.ops.table import VARIABLES
from export_model.converters.policy.facts import SourceFacts
from export_model.signatures.errors import NotAPolicyError, SourceError, UsageError

NAME = "policy"
#: The values go by the graph's name: whoever is handed that is handed them, too.
_GRAPH, _VALUES = "graph.pb", "graph.pb.npz"


class SessionValues:
    """The values of variables by their nodes' names, as ``converters/formats/checkpoint/freeze.py`` takes them."""

    place = "live session"

    def __init__(self, values: Mapping[str, np.ndarray]) -> None:
        self.values = values

    def __contains__(self, name: str) -> bool:
        return name in self.values

    def read(self, name: str, extents: Extents | None = None) -> np.ndarray:
        """The value of a variable; a session has no parts of one."""
        return self.values[name]

    def missing(self, keys: Sequence[str]) -> NotAPolicyError:
        """The error for variables that were not initialised."""
        return NotAPolicyError(
            f"the session has no value for the variable {several(keys)}",
            why="the policy needs it, and it was not initialised, or nothing in the graph reads it by itself",
            fix="run the initializer, or restore a checkpoint, before the export",
        )


def read_session(tensorflow: Any, session: Any, folder: Path) -> SourceModel:
    """The model of a session. Raises UsageError for what is no session, or a closed one; SourceError, GraphError."""
    v1 = tensorflow.compat.v1
    if not isinstance(session, v1.Session | v1.InteractiveSession):
        raise UsageError(
            f"session must be a tf.compat.v1.Session; it is a {type(session).__name__}",
            fix="give the session that the policy was trained in; of a MonitoredSession, its raw session",
        )
    data = flatten_graph(session.graph)
    graph = training_graph(schema.parse(schema.GraphDef, data, "TensorFlow graph")).graph
    values = _values(tensorflow, session, wanted_variables(graph))
    # By the nodes' own names: what a saver in the graph calls them does not matter here.
    places = {n.name: SavedVariable(n.name) for n in graph.nodes if n.op in VARIABLES}
    frozen, notes = policy_nodes(freeze(TrainingGraph(graph, places), SessionValues(values)).graph)
    (folder / _GRAPH).write_bytes(data)
    np.savez(folder / _VALUES, *values.values())
    options = {"kind": "values", "names": list(values), **BUILT_BY_PYTHON}
    original = OriginalRun("tensorflow", folder / _GRAPH, options)
    return SourceModel(frozen, (), SourceFacts(notes=notes), NAME, original)


def _values(tensorflow: Any, session: Any, names: Iterable[str]) -> dict[str, np.ndarray]:
    """The values of variables, of one moment; without those that are not initialised, or cannot be read."""
    tensors = {name: tensor for name in names if (tensor := _reading(session.graph, name)) is not None}
    errors = tensorflow.errors
    try:
        try:
            read = session.run(tensors)
        except (errors.FailedPreconditionError, errors.NotFoundError):
            read = {}
            for name, tensor in tensors.items():
                try:
                    read[name] = session.run(tensor)
                except (errors.FailedPreconditionError, errors.NotFoundError):
                    continue  # freezing says so if the policy needs it
    except RuntimeError as error:
        raise UsageError(
            "the session cannot be run", why=str(error), fix="export before the session is closed"
        ) from error
    except errors.OpError as error:
        raise SourceError(
            "the variables cannot be read",
            why=error.message[:600],
            fix="check that session.run(variable) works, or give a checkpoint of the run",
        ) from error
    arrays = {name: np.asarray(value) for name, value in read.items()}
    return {name: array for name, array in arrays.items() if array.dtype.kind not in "OSU"}


def _reading(graph: Any, name: str) -> Any:
    """A tensor of the graph that is a variable's value, and that nothing else happens for; None where there is none."""
    output = graph.get_operation_by_name(name).outputs[0]
    if output.op.type != "VarHandleOp":
        return output
    reads = [o for o in output.consumers() if o.type == "ReadVariableOp" and not o.control_inputs]
    return reads[0].outputs[0] if reads else None
