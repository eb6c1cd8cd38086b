"""Writes small Keras models, each with a layer or two: ``python -m tests.keras_reader.make_models FOLDER``.

A program of its own, so that a test process need not load Keras. Beside ``<name>.keras`` and ``<name>.h5`` lies
``<name>.npz``: ``in/<number>`` as they were fed, ``out/<number>`` as Keras answered.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

os.environ.update(TF_CPP_MIN_LOG_LEVEL="3", TF_ENABLE_ONEDNN_OPTS="0", CUDA_VISIBLE_DEVICES="-1")

import keras
from keras import layers as k

from tests.keras_reader.operation_models import OPERATIONS

RANDOM = np.random.default_rng(11)
#: Models that are written as HDF5 too: one of each way in which weights are named.
OLDER = (
    *("dense", "mobile", "lstm over a history", "attention", "nested", "shared", "bidirectional lstm"),
    *("operations on an image", "spectral", "grouped queries"),
)
Model = Callable[[], Any]


def chain(shape: Sequence[int], *layers: Any, dtype: str = "float32") -> Model:
    """A sequential model."""
    return lambda: keras.Sequential([keras.Input(shape, dtype=dtype), *layers])


def joined(layer: Any, *shapes: Sequence[int]) -> Model:
    """A layer on several inputs."""

    def make() -> Any:
        inputs = [keras.Input(s, name=f"in_{i}") for i, s in enumerate(shapes)]
        return keras.Model(inputs, layer(inputs))

    return make


def of_one(shape: Sequence[int], function: Callable[[Any], Any], dtype: str = "float32") -> Model:
    """A functional model of one input."""

    def make() -> Any:
        x = keras.Input(shape, name="observation", dtype=dtype)
        return keras.Model(x, function(x))

    return make


def nested(x: Any) -> Any:
    inside = keras.Input([4])
    inner = keras.Model(inside, k.BatchNormalization()(k.Dense(3)(inside)), name="inner")
    return keras.Sequential([k.Dense(4, activation="relu"), k.Dense(2)])(inner(k.Dense(4)(x)))


def shared(x: Any) -> Any:
    twice = k.Dense(3, activation="tanh")
    return k.Concatenate()([twice(x), twice(k.Dropout(0.3)(x * 2.0))])


def with_states(x: Any) -> Any:
    states = [k.Dense(5)(k.Flatten()(x)) for _ in range(2)]
    value, h, c = k.LSTM(5, return_state=True)(x, initial_state=states)
    return [value, h, c]


def cells(x: Any) -> list[Any]:
    """Cells that are called by themselves, with the states that they are given."""
    states = [k.Dense(5)(x) for _ in range(2)]
    value, (h, c) = k.LSTMCell(5)(x, states)
    return [value, h, c, k.GRUCell(5)(x, states[:1])[0], k.SimpleRNNCell(5)(x, states=states[:1])[0]]


def operations(x: Any) -> Any:
    value = keras.ops.clip(x, -1, 1) + keras.ops.mean(x, axis=1, keepdims=True)
    value = keras.ops.concatenate([value, x[:, :2], 1.0 - x[:, 2:5]], axis=-1) * 2.0
    value = keras.ops.elu(value, alpha=0.3)
    return keras.ops.softmax(keras.ops.gelu(value)) / keras.ops.exp(keras.ops.reshape(value, (-1, 11)))


def masked(x: Any) -> Any:
    return k.MultiHeadAttention(2, 3)(x, x, use_causal_mask=True)


def told(x: Any) -> Any:
    value, shares = k.MultiHeadAttention(3, 4, value_dim=2, output_shape=5)(
        x, k.Dense(6)(x), return_attention_scores=True
    )
    return [value, shares]


NAMES = (
    *("relu", "relu6", "sigmoid", "tanh", "elu", "selu", "celu", "softplus", "softsign", "exponential", "silu", "mish"),
    *("gelu", "leaky_relu", "hard_sigmoid", "hard_silu", "hard_tanh", "softmax", "log_softmax", "log_sigmoid"),
    *("squareplus", "tanh_shrink", "hard_shrink", "soft_shrink", "sparse_plus", "sparse_sigmoid", "linear"),
)
FIRST = {"data_format": "channels_first"}
MODELS: dict[str, Model] = {
    "dense": chain([6], k.Dense(4, activation="relu"), k.Dense(3, use_bias=False)),
    "dense on three axes": chain([3, 6], k.Dense(4, activation="swish"), k.Flatten(), k.Dense(2)),
    "activations": of_one([6], lambda x: [k.Activation(name)(x) for name in NAMES]),
    "activation layers": of_one(
        [6],
        lambda x: [
            *(k.ReLU()(x), k.ReLU(0.8, 0.1)(x), k.ReLU(None, 0.2, 0.3)(x), k.ReLU(1.0, 0.0, 0.5)(x)),
            k.ReLU(threshold=1.0)(k.Rescaling(0.0, 1.0)(x)),
            *(k.LeakyReLU()(x), k.LeakyReLU(0.05)(x), k.ELU(0.7)(x), k.PReLU()(x)),
            *(k.Softmax()(k.Reshape([2, 3])(x)), k.Softmax(axis=1)(k.Reshape([2, 3])(x))),
            *(k.Dense(2, activation=k.LeakyReLU(0.3))(x), k.PReLU(shared_axes=[1])(k.Reshape([2, 3])(x))),
        ],
    ),
    "normalisations": of_one(
        [4, 6],
        lambda x: [
            *(k.LayerNormalization()(x), k.LayerNormalization(axis=[1, 2], scale=False)(x)),
            *(k.LayerNormalization(axis=1, center=False)(x), k.BatchNormalization()(x)),
            *(k.BatchNormalization(axis=1, scale=False)(x), k.BatchNormalization(center=False, epsilon=0.1)(x)),
            *(k.GroupNormalization(3)(x), k.GroupNormalization(-1)(x), k.UnitNormalization()(x)),
            *(k.RMSNormalization()(x), k.UnitNormalization()(k.Rescaling(1e-8)(x))),
        ],
    ),
    "numbers": of_one(
        [4, 3],
        lambda x: [
            *(k.Rescaling(0.5, 0.1)(x), k.Normalization(mean=[1, 2, 3], variance=[4, 5, 6])(x)),
            *(k.Normalization(mean=0.5, variance=2.0, axis=None)(x), k.Normalization()(x), k.Normalization(axis=1)(x)),
            k.Normalization(mean=0.5, variance=2.0, axis=None, invert=True)(x),
        ],
    ),
    "mobile": chain(
        [11, 9, 3],
        *(k.Rescaling(1 / 255.0), k.ZeroPadding2D(((1, 2), (0, 1))), k.Conv2D(4, 3, strides=2, padding="same")),
        *(k.BatchNormalization(), k.ReLU(6.0), k.DepthwiseConv2D(3, padding="same", depth_multiplier=2)),
        *(k.SeparableConv2D(5, 3, activation="relu"), k.AveragePooling2D(2, padding="same"), k.GlobalMaxPooling2D()),
    ),
    "convolutions": of_one(
        [9, 8, 4],
        lambda x: [
            *(k.Conv2D(3, (2, 3), strides=(2, 1))(x), k.Conv2D(4, 3, dilation_rate=2, use_bias=False)(x)),
            *(k.Conv2D(6, 3, groups=2, activation="tanh")(x), k.DepthwiseConv2D(3, strides=2)(x)),
            *(k.DepthwiseConv2D(2, dilation_rate=2)(x), k.Conv2DTranspose(3, 3, strides=2)(x)),
            *(k.Conv2DTranspose(3, 4, strides=2, padding="same")(x), k.Conv2DTranspose(2, 2, strides=3)(x)),
            *(k.Conv2DTranspose(2, 2, strides=3, padding="same")(x), k.Conv2DTranspose(2, 5, padding="same")(x)),
        ],
    ),
    "sequences": of_one(
        [10, 4],
        lambda x: [
            *(k.Conv1D(3, 4, strides=2, padding="same")(x), k.Conv1D(3, 3, padding="causal", dilation_rate=2)(x)),
            *(k.Conv1D(4, 3, groups=2)(x), k.SeparableConv1D(3, 3, strides=2)(x), k.DepthwiseConv1D(3)(x)),
            *(k.Conv1DTranspose(3, 3, strides=2, padding="same")(x), k.Conv1DTranspose(3, 3, strides=2)(x)),
            *(k.MaxPooling1D(3, strides=2, padding="same")(x), k.AveragePooling1D(2)(x), k.UpSampling1D(3)(x)),
            *(k.ZeroPadding1D((1, 2))(x), k.Cropping1D((2, 1))(x), k.GlobalAveragePooling1D()(x)),
            *(
                k.GlobalMaxPooling1D(keepdims=True)(x),
                k.SpatialDropout1D(0.5)(x),
                k.RepeatVector(2)(k.Flatten()(x)),
                k.Permute([2, 1])(x),
            ),
            *(k.TimeDistributed(k.Dense(3, activation="relu"))(x), k.Reshape([5, -1])(x)),
        ],
    ),
    "images": of_one(
        [6, 7, 2],
        lambda x: [
            *(k.MaxPooling2D()(x), k.MaxPooling2D(3, strides=1, padding="same")(x), k.UpSampling2D((2, 1))(x)),
            *(k.AveragePooling2D((2, 3), strides=(1, 2))(x), k.Cropping2D(((1, 0), (2, 1)))(x), k.ZeroPadding2D(1)(x)),
            *(k.GlobalAveragePooling2D()(x), k.SpatialDropout2D(0.5)(x), k.GaussianNoise(1.0)(x)),
            *(k.GaussianDropout(0.5)(x), k.AlphaDropout(0.5)(x), k.ActivityRegularization(0.1)(x), k.Identity()(x)),
            k.TimeDistributed(k.Conv1D(3, 2))(x),
        ],
    ),
    "resized": of_one(
        [9, 7, 2],
        lambda x: [
            *(k.Resizing(5, 4)(x), k.Resizing(12, 15)(x), k.Resizing(4, 14, interpolation="nearest")(x)),
            *(k.CenterCrop(4, 4)(x), k.CenterCrop(9, 6)(x)),
            *(k.UpSampling2D(2, interpolation="bilinear")(x), k.UpSampling2D((1, 3), interpolation="bilinear")(x)),
        ],
    ),
    "channels first": of_one(
        [2, 6, 7],
        lambda x: [
            *(k.UpSampling2D(2, **FIRST)(x), k.ZeroPadding2D(1, **FIRST)(x), k.Flatten(**FIRST)(x)),
            *(k.GlobalAveragePooling2D(**FIRST)(x), k.Cropping2D(1, **FIRST)(x)),
        ],
    ),
    **{
        f"merge {kind.__name__}": joined(kind(), [2, 3], [2, 3], [2, 3])
        for kind in (k.Add, k.Multiply, k.Average, k.Maximum, k.Minimum, k.Concatenate)
    },
    "merge Subtract": joined(k.Subtract(), [3], [3]),
    "merge along rows": joined(k.Concatenate(axis=1), [2, 3], [4, 3]),
    "merge of unlike ranks": joined(k.Add(), [3], [2, 3]),
    "merge Dot": joined(k.Dot(axes=(2, 1)), [4, 3], [3, 5]),
    "merge Dot of vectors": joined(k.Dot(axes=1), [4], [4]),
    "embedding": chain([5], k.Embedding(7, 4), k.Flatten(), k.Dense(2), dtype="int32"),
    "einsum": chain([3, 4], k.EinsumDense("abc,cd->abd", output_shape=(None, 5), bias_axes="d", activation="relu")),
    "lstm over a history": chain([5, 4], k.LSTM(6, return_sequences=True), k.LSTM(3)),
    "gru over a history": chain([4, 3], k.GRU(5, return_sequences=True), k.GRU(3, reset_after=False), k.Dense(2)),
    "recurrent settings": of_one(
        [3, 4],
        lambda x: [
            *(k.SimpleRNN(3)(x), k.SimpleRNN(2, activation="relu", use_bias=False)(x)),
            *(k.LSTM(3, activation="relu", recurrent_activation="hard_sigmoid", use_bias=False)(x),),
            *(k.GRU(3, activation="elu", use_bias=False)(x), k.LSTM(3, go_backwards=True, return_sequences=True)(x)),
            *k.GRU(3, return_state=True, unroll=True)(x),
            k.RNN([k.LSTMCell(3), k.GRUCell(4)])(x),
            k.RNN(k.SimpleRNNCell(3), return_sequences=True)(x),
        ],
    ),
    "lstm with states": of_one([3, 4], with_states),
    "cells": of_one([4], cells),
    "bidirectional lstm": of_one(
        [4, 3],
        lambda x: [
            *(k.Bidirectional(k.LSTM(3))(x), k.Bidirectional(k.GRU(2, return_sequences=True), merge_mode="sum")(x)),
            k.Bidirectional(k.LSTM(3, return_sequences=True))(x),
        ],
    ),
    "attention": of_one([5, 6], lambda x: k.MultiHeadAttention(2, 3)(x, x)),
    "attention to later steps": of_one([5, 6], masked),
    "attention, shares told": of_one([5, 6], told),
    "dot-product attention": of_one([4, 6], lambda x: k.Attention(use_scale=True)([x, k.Dense(6)(x)])),
    "additive attention": of_one(
        [4, 6],
        lambda x: [
            *(k.AdditiveAttention()([x, k.Dense(6)(x)[:, 1:]]), k.AdditiveAttention(use_scale=False)([x, x, x * 2])),
            *k.AdditiveAttention()([x, x], return_attention_scores=True, use_causal_mask=True),
        ],
    ),
    "grouped queries": of_one(
        [4, 6],
        lambda x: [
            k.GroupQueryAttention(4, 6, 2)(x, k.Dense(6)(x)[:, 1:]),
            *k.GroupQueryAttention(3, 3, 1, use_bias=False)(x, x, use_causal_mask=True, return_attention_scores=True),
        ],
    ),
    "spectral": chain(
        [6, 5, 1],
        *(k.SpectralNormalization(k.Conv2D(3, 2, activation="relu")), k.Flatten()),
        *(k.SpectralNormalization(k.Dense(1, use_bias=False)), k.SpectralNormalization(k.Dense(4)), k.Dense(2)),
    ),
    "categories": of_one(
        [3],
        lambda x: [
            *(k.CategoryEncoding(8)(x), k.CategoryEncoding(8, output_mode="one_hot")(x)),
            *(k.CategoryEncoding(8, output_mode="count")(x), k.CategoryEncoding(4, output_mode="one_hot")(x[:, :1])),
        ],
        "int32",
    ),
    "bins": of_one(
        [3],
        lambda x: [
            k.Discretization([-1.0, 0.0, 0.5])(x),
            *(k.Discretization([-1.0, 0.0, 0.5], output_mode=mode)(x) for mode in ("one_hot", "multi_hot", "count")),
        ],
    ),
    "nested": of_one([6], nested),
    "shared": of_one([6], shared),
    "operations": of_one([6], operations),
    **{name: of_one(shape, function, dtype) for name, (shape, dtype, function) in OPERATIONS.items()},
}


def filled(model: Any) -> Any:
    """The model with random weights; variances are above 0."""
    for weight in model.weights:
        values = RANDOM.uniform(-0.7, 0.7, weight.shape)
        weight.assign(np.abs(values) + 0.1 if "variance" in weight.path else values)
    for layer in model.layers:
        if isinstance(layer, k.Normalization) and layer.input_mean is None:
            layer.finalize_state()
    return model


def main(folder: Path) -> None:
    for name, make in MODELS.items():
        if len(sys.argv) > 2 and name not in sys.argv[2:]:
            continue
        keras.backend.clear_session()
        model = filled(make())
        fed = []
        for tensor in model.inputs:
            values = RANDOM.uniform(-2, 2, (3, *tensor.shape[1:]))
            scale = 64 if tensor.dtype == "uint8" else 2
            whole = "int" in tensor.dtype
            fed.append(np.abs(values * scale).astype(tensor.dtype) if whole else values.astype("float32"))
        given = model(fed if len(fed) > 1 else fed[0], training=False)
        given = given if isinstance(given, list | tuple) else [given]
        model.save(folder / f"{name}.keras")
        if name in OLDER:
            model.save(folder / f"{name}.h5")
        arrays = {f"in/{i}": a for i, a in enumerate(fed)} | {f"out/{i}": np.asarray(a) for i, a in enumerate(given)}
        np.savez(folder / f"{name}.npz", **arrays)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
