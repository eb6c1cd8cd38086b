"""TensorFlow's Python in a process of its own, or beside the C interface (child.py) for what it alone builds.

What a model is loaded from, by ``kind``: ``graph`` (a frozen GraphDef), ``values`` (the training graph of a session of
the user's, its variables' values in the numpy archive beside it, in the order of ``names``), ``function`` (a
SavedModel of TensorFlow 2 or a Keras model, as TensorFlow itself freezes it), ``saved_model`` (a SavedModel called by
``signature``), ``keras`` (a Keras model of Keras' own layers, which is not run but given back as bytes: its GraphDef as
``graph``, a JSON object of its inputs' and outputs' tensors as ``names``).

``python -m export_model.converters.runtimes.tensorflow.python``
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np

from export_model.converters.files.children.child import Model, claim_stdout, serve
from export_model.converters.files.children.frames import Tensors
from export_model.converters.runtimes.tensorflow.library import TensorFlowError
from export_model.signatures.errors import ExportModelError

#: What bad models and inputs raise, in the names that need no import of TensorFlow.
FAULTS = (TensorFlowError, AttributeError, RuntimeError, ImportError, ExportModelError)


def set_environment() -> None:
    """Before TensorFlow is loaded: no log lines, no oneDNN (it changes rounding), no search for a GPU."""
    os.environ.update(TF_CPP_MIN_LOG_LEVEL="3", TF_ENABLE_ONEDNN_OPTS="0", CUDA_VISIBLE_DEVICES="-1")


def main() -> None:
    """Entry of the child process."""
    out = claim_stdout()
    set_environment()
    serve_python(out)


def serve_python(out: BinaryIO) -> NoReturn:
    """Answer requests by TensorFlow's Python alone."""
    serve("tensorflow", f"{_tensorflow().__version__} (Python)", load, FAULTS, out)


@cache
def _tensorflow() -> Any:
    """The module, set to one thread so that sums repeat."""
    import tensorflow as tf  # noqa: TID251  this is the child process

    tf.config.threading.set_intra_op_parallelism_threads(1)
    tf.config.threading.set_inter_op_parallelism_threads(1)
    return tf


def load(header: Mapping[str, Any]) -> Model:
    """What a request describes. Raises one of FAULTS."""
    kind, path = header["kind"], header["path"]
    _tensorflow()  # before anything computes: the number of threads is set once
    with _named_faults():
        if kind == "saved_model":
            return _Saved(path, header.get("signature", "serving_default"))
        if kind == "values":
            return _load_with_values(path, header["names"])
        if kind == "graph":
            return _load_frozen(path, source=header.get("source", False))
        # only these need what freezes, and the imports of that
        from export_model.converters.formats.live.freeze import frozen_function

        if kind == "keras":
            from export_model.converters.formats.keras.config import config_inside, refuse_code

            refuse_code(config_inside(path), built=True)
            return _Frozen(frozen_function(path, "keras"))
        definition = frozen_function(path, header["form"], header.get("signature")).graph_def
        return _InSession(_import_graph(definition), source=True)


@contextmanager
def _named_faults() -> Iterator[None]:
    """Raise what TensorFlow's own errors say as TensorFlowError."""
    try:
        yield
    except _tensorflow().errors.OpError as error:
        raise TensorFlowError(f"{type(error).__name__}: {error}") from error


class _InSession:
    """A graph in a Session; feeds and fetches are tensor names, inner ones too.

    The doubles of a ``source`` are given as float32, as which they are exported.
    """

    def __init__(self, graph: Any, *, source: bool = False) -> None:
        self.source = source
        v1 = _tensorflow().compat.v1
        self.session = v1.Session(graph=graph, config=v1.ConfigProto(allow_soft_placement=True))

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        given = {_tensor(name): self._fitting(_tensor(name), array) for name, array in feeds.items()}
        with _named_faults():
            values = self.session.run([_tensor(n) for n in fetch], given)
        if self.source:
            values = [v.astype(np.float32) if v.dtype == np.float64 else v for v in values]
        return dict(zip(fetch, values, strict=True))

    def _fitting(self, name: str, array: Any) -> Any:
        """A row as a source takes it that has no axis for the agents."""
        shape = self.session.graph.get_tensor_by_name(name).shape
        alone = shape.is_fully_defined() and shape.rank != array.ndim and shape.num_elements() == array.size
        return array.reshape(shape.as_list()) if alone else array


def _import_graph(definition: Any) -> Any:
    tf = _tensorflow()
    for node in definition.node:
        node.device = ""
    graph = tf.Graph()
    with graph.as_default():
        tf.import_graph_def(definition, name="")
    return graph


def _load_frozen(path: str, *, source: bool) -> _InSession:
    definition = _tensorflow().compat.v1.GraphDef.FromString(Path(path).read_bytes())
    return _InSession(_import_graph(definition), source=source)


def _load_with_values(path: str, names: Sequence[str]) -> _InSession:
    """A training graph with values that were read from a session; variables are told by their nodes' names."""
    from export_model.converters.graph.ops.table import VARIABLES

    tf, model = _tensorflow(), _load_frozen(path, source=True)
    with np.load(f"{path}.npz", allow_pickle=False) as kept:
        values = {name: kept[f"arr_{i}"] for i, name in enumerate(names)}
    graph = model.session.graph
    with graph.as_default():
        for operation in graph.get_operations():
            value = values.get(operation.name)
            if value is not None and operation.type == "VarHandleOp":
                model.session.run(tf.raw_ops.AssignVariableOp(resource=operation.outputs[0], value=value))
            elif value is not None and operation.type in VARIABLES:
                model.session.run(tf.raw_ops.Assign(ref=operation.outputs[0], value=value).op)
    return model


class _Saved:
    """A SavedModel, called as TensorFlow 2 does: one signature, inputs by name."""

    def __init__(self, path: str, signature: str) -> None:
        self.keep = _tensorflow().saved_model.load(path)
        self.function = self.keep.signatures[signature]

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        constant = _tensorflow().constant
        with _named_faults():
            results = self.function(**{name: constant(array) for name, array in feeds.items()})
        return {name: results[name].numpy() for name in fetch}


class _Frozen:
    """A model that TensorFlow froze, given back as bytes (see the head of this file)."""

    def __init__(self, function: Any) -> None:
        self.function = function

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        function = self.function
        names = {"inputs": function.inputs, "outputs": function.outputs, "signature": function.signature}
        graph = function.graph_def.SerializeToString(deterministic=True)
        return {name: np.frombuffer(data, np.uint8) for name, data in
                (("graph", graph), ("names", json.dumps(names).encode()))}  # fmt: skip


def _tensor(name: str) -> str:
    return name if ":" in name else f"{name}:0"


if __name__ == "__main__":
    main()
