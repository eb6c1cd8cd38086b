"""Writes networks that value actions, and some that do not.

``python -m tests.keras_reader.make_value_networks FOLDER``, a program of its own, so that a test process need not load
Keras. Beside ``<name>.keras`` and ``<name>.h5`` lies
``<name>.npz``: ``observed``, and ``answered`` by Keras.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

os.environ.update(TF_CPP_MIN_LOG_LEVEL="3", TF_ENABLE_ONEDNN_OPTS="0", CUDA_VISIBLE_DEVICES="-1")

import keras
from keras import layers as k

HIDDEN = {"activation": "relu", "bias_initializer": keras.initializers.RandomNormal(seed=4)}


def chain(last: Any, loss: Any = None, name: str | None = None) -> Any:
    model = keras.Sequential([keras.Input([4]), k.Dense(8, **HIDDEN), last], name=name)
    if loss is not None:
        model.compile(optimizer="adam", loss=loss)
    return model


def dueling() -> Any:
    x = keras.Input([4])
    h = k.Dense(8, **HIDDEN)(x)
    value, advantage = k.Dense(1)(h), k.Dense(3)(h)
    return keras.Model(x, value + (advantage - keras.ops.mean(advantage, axis=1, keepdims=True)))


def heads(**layers: Any) -> Any:
    """Several outputs of one network, by the names that their layers have."""
    x = keras.Input([4])
    h = k.Dense(8, **HIDDEN)(x)
    return keras.Model(x, [k.Dense(size, activation=how, name=name)(h) for name, (size, how) in layers.items()])


def main(folder: Path) -> None:
    keras.utils.set_random_seed(5)
    made = {
        # values of actions
        "q_values": chain(k.Dense(3, name="q_values")),
        "letter": chain(k.Dense(3, name="Q")),
        "dqn": chain(k.Dense(3), name="dqn"),
        "mse": chain(k.Dense(3, activation="linear", name="last"), "mse"),
        "huber": chain(k.Dense(3, name="last"), keras.losses.Huber()),
        "function": chain(k.Dense(3, name="last"), keras.losses.mean_squared_error),
        # what may be either
        "open": chain(k.Dense(3, name="last")),
        # continuous actions and choices
        "actor": chain(k.Dense(3, activation="tanh", name="last"), "mse"),
        "named": chain(k.Dense(3, name="action"), "mse"),
        "choice": chain(k.Dense(3, activation="softmax", name="last"), "categorical_crossentropy"),
        # no policy
        "critic": chain(k.Dense(1, name="value"), "mse"),
        "called": chain(k.Dense(1, name="last"), name="critic"),
    }
    several = {
        "probs": heads(value=(1, None), probs=(3, "softmax")),
        "logits": heads(logits=(3, None), value=(1, None)),
        "policy": heads(policy=(3, "softmax"), critic=(1, None)),
        "mu": heads(mu=(3, "tanh"), log_std=(3, None)),
    }
    for name, model in several.items():
        model.save(folder / f"{name}.keras")
        model.save(folder / f"{name}.h5")
        keras.Model(model.inputs, dict(zip(model.output_names, model.outputs, strict=True))).export(
            folder / name, verbose=False
        )
    observed = np.random.default_rng(3).standard_normal((64, 4)).astype(np.float32) * 2
    for name, model in several.items():
        answers = dict(zip(model.output_names, model.predict(observed, verbose=0), strict=True))
        np.savez(folder / f"{name}.npz", observed=observed, answered=answers[name])
    for name, model in [*made.items(), ("dueling", dueling())]:
        model.save(folder / f"{name}.keras")
        if name != "dueling":  # an operation without a name of its own cannot be saved as HDF5
            model.save(folder / f"{name}.h5")
        np.savez(folder / f"{name}.npz", observed=observed, answered=model.predict(observed, verbose=0))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
