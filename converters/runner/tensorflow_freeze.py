"""What only TensorFlow can freeze: SavedModels of TensorFlow 2 and Keras models. For children that have imported it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class FrozenFunction:
    """A flat GraphDef, and which of its tensors are the function's arguments and results, by their names."""

    graph_def: Any
    inputs: dict[str, str]
    outputs: dict[str, str]
    signature: str


def frozen_function(path: str, form: str, signature: str | None = None) -> FrozenFunction:
    """The signature of a SavedModel (``form`` "saved_model"), or the call of a Keras model ("keras"), frozen.

    Control flow is lowered to Switch and Merge, functions are inlined, variables become constants.
    """
    import tensorflow as tf  # noqa: TID251  in a child process only
    from tensorflow.python.framework.convert_to_constants import convert_variables_to_constants_v2  # noqa: TID251

    if form == "keras":
        model = tf.keras.models.load_model(path, compile=False)
        names = [_argument(t.name, i) for i, t in enumerate(model.inputs)]
        specs = [
            tf.TensorSpec([None, *t.shape[1:]], t.dtype, name=name) for name, t in zip(names, model.inputs, strict=True)
        ]
        structure = model._inputs_struct if hasattr(model, "_inputs_struct") else list(model.inputs)

        def call(*tensors: Any) -> Any:
            return model(tf.nest.pack_sequence_as(structure, tensors), training=False)

        function = tf.function(call).get_concrete_function(*specs)
        results = tf.nest.flatten(function.structured_outputs)
        keys = list(getattr(model, "output_names", [])) or [f"output_{i}" for i in range(len(results))]
        used = "call"
    else:
        loaded = tf.saved_model.load(path)
        available = list(loaded.signatures)
        if not available:
            raise ValueError("the SavedModel has no signatures; save it with signatures=…")
        used = signature or ("serving_default" if "serving_default" in available else available[0])
        if used not in available:
            raise ValueError(f"there is no signature {used!r}; there are {', '.join(available)}")
        function = loaded.signatures[used]
        keys = sorted(function.structured_outputs)  # results are flattened in the order of their keys
        names = [t.name.split(":")[0] for t in function.inputs if t.dtype != tf.resource]
        if set(names) != set(function.structured_input_signature[1]):
            names = list(function._arg_keywords)
    frozen = convert_variables_to_constants_v2(function, lower_control_flow=True)
    return FrozenFunction(
        frozen.graph.as_graph_def(),
        dict(zip(names, (t.name for t in frozen.inputs), strict=True)),
        dict(zip(keys, (t.name for t in frozen.outputs), strict=True)),
        used,
    )


def _argument(name: str, number: int) -> str:
    """A layer's name as an argument's: what comes after the last slash, without the output's number."""
    return name.split(":")[0].rsplit("/", 1)[-1] or f"input_{number}"
