"""A ``tf.function`` and a Keras model: written as a SavedModel, and read from there as any SavedModel of TensorFlow 2.

TensorFlow freezes it in this process, which has loaded it; the child that runs the original freezes the same files.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.formats.live.freeze import keras_call, keras_outputs, named_function, saved_function
from export_model.converters.formats.saved_model.signature import expose_signature, signature_of
from export_model.converters.formats.source import BUILT_BY_PYTHON, OriginalRun, SourceModel
from export_model.signatures.errors import SourceError, UsageError

NAME = "policy"
#: Names of functions that say nothing of a policy.
_NAMELESS = ("call", "lambda", "inner", "wrapped", "")
_CONCRETE = "give f.get_concrete_function(tf.TensorSpec([None, 8], tf.float32, name='vector_observation'), …)"
_REFUSALS = (AssertionError, AttributeError, KeyError, LookupError, NotImplementedError, TypeError, ValueError)


def read_function(tensorflow: Any, function: Any, folder: Path) -> SourceModel:
    """The model of a tf.function or ConcreteFunction. Raises UsageError, SourceError, and what a SavedModel raises."""
    kinds = tensorflow.types.experimental
    if isinstance(function, kinds.ConcreteFunction):
        name = str(getattr(function.graph, "name", ""))
        return _read(tensorflow, lambda: function, folder, _name(name))
    if not isinstance(function, kinds.GenericFunction):
        raise UsageError(
            f"tf_function must be a tf.function; it is a {type(function).__name__}",
            fix="wrap it: tf.function(f, input_signature=[tf.TensorSpec([None, 8], name='vector_observation')])",
        )
    name = str(getattr(function.python_function, "__name__", ""))
    return _read(tensorflow, lambda: _only_concrete(function), folder, _name(name))


def _only_concrete(function: Any) -> Any:
    """The ConcreteFunction that a tf.function stands for. Raises UsageError where it stands for none or several."""
    if function.input_signature is not None:
        return function.get_concrete_function()
    traced = list(function._list_all_concrete_functions())
    if len(traced) == 1:
        return traced[0]
    raise UsageError(
        f"tf_function has no input_signature, and was traced for {len(traced) or 'no'} signatures",
        why="which tensors it takes is not known",
        fix=_CONCRETE,
    )


def read_keras(tensorflow: Any, model: Any, folder: Path) -> SourceModel:
    """The model of a Keras model, called with ``training=False``. Raises UsageError, SourceError."""
    bases = {(c.__module__.partition(".")[0], c.__name__) for c in type(model).__mro__}
    if not bases & {("keras", "Model"), ("tf_keras", "Model"), ("tensorflow", "Model")}:
        raise UsageError(f"keras_model must be a Keras model; it is a {type(model).__name__}", fix="give a keras.Model")
    backend = getattr(sys.modules.get("keras"), "backend", None)
    if ("keras", "Model") in bases and backend is not None and backend.backend() != "tensorflow":
        raise UsageError(
            f"keras_model computes with {backend.backend()}",
            why="a graph can only be taken of TensorFlow's functions",
            fix="save it (model.save('policy.keras')), and give the file",
        )
    try:
        inputs = model.inputs
    except (AttributeError, ValueError):
        inputs = None
    if not inputs:
        raise UsageError(
            f"keras_model {model.name!r} does not say its inputs",
            why="it is a subclass of keras.Model, or was never built",
            fix="give tf_function=tf.function(model).get_concrete_function(tf.TensorSpec([None, 8], tf.float32, "
            "name='vector_observation'))",
        )

    def concrete() -> Any:
        call, specs, _ = keras_call(model)
        return named_function(call, specs, lambda count: keras_outputs(model, count))

    return _read(tensorflow, concrete, folder, str(model.name))


def _check_rows(function: Any) -> None:
    """Raise UsageError where a function was traced for one number of rows, as by a call with values."""
    shapes = [list(t.shape) for t in function.inputs if t.dtype.name != "resource" and t.shape.rank]
    if shapes and all(shape[0] is not None for shape in shapes):
        raise UsageError(
            f"tf_function takes {shapes[0][0]} rows only",
            why="it was traced with the shapes of one call; a policy takes any number of agents",
            fix=_CONCRETE,
        )


def _name(function: str) -> str:
    stem = re.sub(r"^(__)?inference_|_\d+$", "", function).strip("_<>")
    return NAME if stem in _NAMELESS else stem


def _read(tensorflow: Any, concrete: Callable[[], Any], folder: Path, name: str) -> SourceModel:
    if not tensorflow.executing_eagerly():
        raise UsageError(
            "a function cannot be exported here: eager execution is off, or a tf.Graph is the default",
            why="the function's variables have no values there",
            fix="leave the graph (with graph.as_default()) first; or give the session: export_model(session=…)",
        )
    try:
        function = concrete()
        _check_rows(function)
        frozen = saved_function(function, str(folder))
    except (*_REFUSALS, tensorflow.errors.OpError) as error:
        raise SourceError(
            "TensorFlow cannot save it",
            why=f"{type(error).__name__}: {' '.join(str(error).split())}"[:600],
            fix="give a function of tensors that returns a tensor or a dictionary of tensors; see that "
            "tf.saved_model.save writes it",
        ) from error
    graph = read_graph(frozen.graph_def.SerializeToString(deterministic=True))
    graph, facts = expose_signature(graph, signature_of(frozen.inputs, frozen.outputs, frozen.signature))
    options = {"kind": "function", "form": "saved_model", "signature": frozen.signature, **BUILT_BY_PYTHON}
    return SourceModel(graph, (), facts, name, OriginalRun("tensorflow", folder, options))
