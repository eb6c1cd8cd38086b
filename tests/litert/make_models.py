"""``python -m tests.litert.make_models FOLDER``: .tflite files of TensorFlow's converter, new and old."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from export_model.exporter.export.pipeline import ExportOptions, export
from fixtures import path

#: Keras layers of one input and one output: activations that the converter has operators for, or writes out.
ACTIVATIONS = ("relu", "relu6", "tanh", "elu", "selu", "gelu", "swish", "leaky_relu", "hard_sigmoid", "softsign")
#: The policies of SavedModels, with both signatures, of which the one that is read is not the file's first function.
SAVED = ("continuous", "discrete", "recurrent", "sampled", "visual")
#: ML-Agents' frozen graphs by the converter of TensorFlow 1, for one agent, without signatures.
FROZEN = ("continuous", "discrete")
#: Files that are refused, and the operator or dtype that is why.
REFUSED = {"quantised": "QUANTIZE", "hybrid": "int8", "stateful": "VAR_HANDLE"}


def _keras(tf: Any) -> Iterator[tuple[str, Any]]:
    layers, model = tf.keras.layers, tf.keras.Model

    def given(*shape: int, name: str = "obs") -> Any:
        return tf.keras.Input(shape, name=name)

    for activation in ACTIVATIONS:
        obs = given(8)
        yield activation, model(obs, layers.Dense(3)(layers.Dense(16, activation=activation)(obs)))
    obs = given(8)
    yield "softmax", model(obs, layers.Dense(3, activation="softmax")(layers.Dense(16)(obs)))
    image = x = given(20, 20, 3, name="visual_observation")
    for layer in (
        layers.Conv2D(8, 3, activation="relu"),
        layers.MaxPool2D(2),
        layers.DepthwiseConv2D(3, padding="same"),
        layers.BatchNormalization(),
        layers.PReLU(),
        layers.AveragePooling2D(2),
        layers.Flatten(),
        layers.Dense(4),
    ):
        x = layer(x)
    yield "image", model(image, x)
    image = x = given(12, 11, 4, name="visual_observation")
    for layer in (
        layers.Conv2D(6, 3, dilation_rate=2, activation="relu"),
        layers.Conv2D(4, (2, 3), dilation_rate=3, padding="same", groups=2),
        layers.DepthwiseConv2D(3, dilation_rate=2),
        layers.Flatten(),
        layers.Dense(4),
    ):
        x = layer(x)
    yield "dilated", model(image, x)
    obs, h, c = given(8), given(16, name="h_in"), given(16, name="c_in")
    out, state = layers.LSTMCell(16)(obs, [h, c])
    yield "cell", model([obs, h, c], {"action": layers.Dense(2)(out), "h_out": state[0], "c_out": state[1]})
    steps = given(5, 8)
    yield "gru", model(steps, layers.Dense(2)(layers.GRU(16, unroll=True)(steps)))
    steps = given(5, 8)
    x = layers.GlobalAveragePooling1D()(layers.MultiHeadAttention(2, 4)(steps, steps))
    yield "attention", model(steps, layers.Dense(2)(x))
    steps = given(5, 8)
    x = layers.Conv1D(4, 2, dilation_rate=2, padding="causal", activation="relu")(steps)
    yield "conv1d-dilated", model(steps, layers.Dense(2)(layers.Flatten()(layers.Conv1D(3, 2, dilation_rate=2)(x))))
    steps = given(5, 8)
    yield "conv1d", model(steps, layers.Dense(2)(layers.Flatten()(layers.Conv1D(4, 2, activation="relu")(steps))))


def main(folder: Path) -> None:
    """Write them all."""
    os.environ.update(TF_CPP_MIN_LOG_LEVEL="3", CUDA_VISIBLE_DEVICES="")
    import numpy as np
    import tensorflow as tf

    def written(name: str, converter: Any, change: Callable[[Any], None] = lambda converter: None) -> None:
        change(converter)
        (folder / f"{name}.tflite").write_bytes(converter.convert())

    def smaller(converter: Any) -> None:
        converter.optimizations = [tf.lite.Optimize.DEFAULT]

    def halves(converter: Any) -> None:
        smaller(converter)
        converter.target_spec.supported_types = [tf.float16]

    def integers(converter: Any) -> None:
        smaller(converter)
        converter.representative_dataset = lambda: ([np.ones((1, 64), np.float32) * i] for i in range(9))

    lite = tf.lite.TFLiteConverter
    tf.random.set_seed(1)
    for name, model in _keras(tf):
        model.set_weights([w + np.float32(0.1) * (np.arange(w.size).reshape(w.shape) % 7) for w in model.get_weights()])
        written(name, lite.from_keras_model(model))
    wide = tf.keras.Sequential([tf.keras.Input((64,)), tf.keras.layers.Dense(64, "tanh"), tf.keras.layers.Dense(4)])
    written("halves", lite.from_keras_model(wide), halves)
    written("hybrid", lite.from_keras_model(wide), smaller)
    written("quantised", lite.from_keras_model(wide), integers)
    call = tf.function(wide, input_signature=[tf.TensorSpec((1, 64), tf.float32)]).get_concrete_function()
    written("stateful", lite.from_concrete_functions([call], wide))
    for name in SAVED:
        (made,) = export([path(name)], ExportOptions(folder / "bundles", ("saved_model",), verify="none"))
        written(f"saved-{name}", lite.from_saved_model(str(made.folder / "saved_model")))
    old = tf.compat.v1
    for name in FROZEN:
        graph = old.GraphDef.FromString(path(name).read_bytes())
        dims = {
            n.name: [max(d.size, 1) for d in n.attr["shape"].shape.dim] for n in graph.node if n.op == "Placeholder"
        }
        outputs = [n.name for n in graph.node if n.name in ("action", "value_estimate")]
        convert = old.lite.TFLiteConverter.from_frozen_graph
        written(f"frozen-{name}", convert(str(path(name)), [*dims], outputs, input_shapes=dims))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
