"""Writes SavedModels, checkpoints and Keras models with TensorFlow: ``python -m tests.saved_model.make_models FOLDER``.

A program of its own, so that a test process need not load TensorFlow. Beside each model lies ``<name>.npz``: what was
fed to it and what TensorFlow computed, by the keys of its signature.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

os.environ.update(TF_CPP_MIN_LOG_LEVEL="3", TF_ENABLE_ONEDNN_OPTS="0", CUDA_VISIBLE_DEVICES="-1")

import tensorflow as tf
from tensorflow.python.framework import type_spec_registry
from tensorflow.python.framework.composite_tensor import CompositeTensor

RANDOM = np.random.default_rng(7)
v1 = tf.compat.v1


def keep(folder: Path, name: str, feeds: Mapping[str, np.ndarray], results: Mapping[str, Any]) -> None:
    inputs = {f"in/{k}": np.asarray(v) for k, v in feeds.items()}
    np.savez(folder / f"{name}.npz", **inputs, **{f"out/{k}": np.asarray(v) for k, v in results.items()})


def draw(*shape: int) -> np.ndarray:
    return RANDOM.standard_normal(shape).astype(np.float32)


def masks(rows: int, width: int) -> np.ndarray:
    array = (RANDOM.random((rows, width)) < 0.6).astype(np.float32)
    array[:, 0] = 1
    return array


# ------------------------------------------------------------------ TensorFlow 1


def dense(x: Any, width: int, name: str, *, resource: bool) -> Any:
    with v1.variable_scope(name, use_resource=resource):
        kernel = v1.get_variable("kernel", initializer=draw(int(x.shape[-1]), width))
        bias = v1.get_variable("bias", initializer=draw(width))
    return tf.matmul(x, kernel) + bias


def tf1_policy(*, resource: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """The continuous policy of the blog that patched the trainer: {in, epsilon} to {out}."""
    observation = v1.placeholder(tf.float32, [None, 6], name="vector_observation")
    noise = v1.placeholder(tf.float32, [None, 2], name="epsilon")
    v1.placeholder(tf.float32, [None], name="advantages")
    hidden = tf.nn.elu(dense(observation, 16, "hidden", resource=resource))
    mu = dense(hidden, 2, "mu", resource=resource)
    sigma = v1.get_variable("log_sigma", initializer=draw(2), use_resource=resource)
    action = tf.identity(tf.clip_by_value(mu + tf.exp(sigma) * noise, -3, 3) / 3, name="action")
    loss = tf.reduce_mean(tf.square(action), name="loss")
    v1.train.AdamOptimizer().minimize(loss)
    return {"in": observation, "epsilon": noise}, {"out": action}


def tf1(folder: Path, name: str, *, resource: bool) -> None:
    with tf.Graph().as_default(), v1.Session() as session:
        inputs, outputs = tf1_policy(resource=resource)
        session.run(v1.global_variables_initializer())
        feeds = {"in": draw(3, 6), "epsilon": draw(3, 2)}
        results = session.run(outputs, {inputs[k]: v for k, v in feeds.items()})
        v1.saved_model.simple_save(session, str(folder / name), inputs, outputs)
        keep(folder, name, feeds, results)


def bare(folder: Path, name: str, *, resource: bool) -> None:
    """A checkpoint beside a graph that was written before it had a saver."""
    target = folder / name
    with tf.Graph().as_default(), v1.Session() as session:
        inputs, outputs = tf1_policy(resource=resource)
        v1.train.write_graph(session.graph, str(target), "raw_graph_def.pb", as_text=False)
        session.run(v1.global_variables_initializer())
        feeds = {"in": draw(3, 6), "epsilon": draw(3, 2)}
        results = session.run(outputs, {inputs[k]: v for k, v in feeds.items()})
        v1.train.Saver().save(session, str(target / "model-1.ckpt"), write_meta_graph=False)
        keep(folder, name, feeds, results)


def discrete_keys(folder: Path) -> None:
    """Nothing in the graph is called as ML-Agents would: only the signature's keys say what is what."""
    with tf.Graph().as_default(), v1.Session() as session:
        x = v1.placeholder(tf.float32, [None, 4])
        m = v1.placeholder(tf.float32, [None, 3])
        logits = dense(x, 3, "a", resource=False)
        allowed = (tf.nn.softmax(logits) + 1e-7) * m
        scores = tf.math.log(allowed / tf.reduce_sum(allowed, 1, keepdims=True) + 1e-7)
        value = dense(x, 1, "b", resource=False)
        inputs, outputs = {"state": x, "action_masks": m}, {"action": scores, "value_estimate": value}
        session.run(v1.global_variables_initializer())
        feeds = {"state": draw(5, 4), "action_masks": masks(5, 3)}
        results = session.run(outputs, {inputs[k]: v for k, v in feeds.items()})
        v1.saved_model.simple_save(session, str(folder / "keys"), inputs, outputs)
        keep(folder, "keys", feeds, results)


def partitioned(folder: Path) -> None:
    """A checkpoint with a variable in three parts, each of which the saver restores as a slice."""
    target = folder / "partitioned"
    target.mkdir()
    with tf.Graph().as_default(), v1.Session() as session:
        x = v1.placeholder(tf.float32, [None, 7], name="vector_observation")
        kernel = v1.get_variable(
            "kernel", shape=[7, 4], initializer=v1.random_normal_initializer(seed=3),
            partitioner=v1.fixed_size_partitioner(3), use_resource=False,
        )  # fmt: skip
        whole = v1.get_variable("whole", initializer=draw(4), use_resource=False)
        action = tf.identity(tf.tanh(tf.matmul(x, tf.convert_to_tensor(kernel)) + whole), name="action")
        saver = v1.train.Saver()
        session.run(v1.global_variables_initializer())
        feeds = {"vector_observation": draw(3, 7)}
        results = session.run({"action": action}, {x: feeds["vector_observation"]})
        saver.save(session, str(target / "model-20.ckpt"))
        keep(folder, "partitioned", feeds, results)


def version_1(folder: Path) -> None:
    target = folder / "version1"
    target.mkdir()
    with tf.Graph().as_default(), v1.Session() as session:
        x = v1.placeholder(tf.float32, [None, 2], name="vector_observation")
        tf.identity(dense(x, 2, "d", resource=False), name="action")
        session.run(v1.global_variables_initializer())
        v1.train.Saver(write_version=v1.train.SaverDef.V1).save(session, str(target / "model-5.ckpt"))
        v1.train.write_graph(session.graph, str(target), "raw_graph_def.pb", as_text=False)


# ------------------------------------------------------------------ TensorFlow 2


class Policy(tf.Module):
    """A discrete policy as people write them in TensorFlow 2."""

    def __init__(self) -> None:
        super().__init__()
        self.kernel = tf.Variable(draw(5, 8))
        self.head = tf.Variable(draw(8, 3))

    @tf.function(
        input_signature=[
            tf.TensorSpec([None, 5], name="vector_observation"),
            tf.TensorSpec([None, 3], name="action_masks"),
        ]
    )
    def __call__(self, vector_observation: Any, action_masks: Any) -> dict[str, Any]:
        logits = tf.nn.relu(vector_observation @ self.kernel) @ self.head
        kept = (tf.nn.softmax(logits) + 1e-7) * action_masks
        return {"action": tf.math.log(kept / tf.reduce_sum(kept, 1, keepdims=True) + 1e-7)}


class Winding(tf.Module):
    """A loop, a branch, nested functions, an op with several results, a variable that is passed through a loop."""

    def __init__(self) -> None:
        super().__init__()
        self.kernel = tf.Variable(draw(5, 4))
        self.bias = tf.Variable(draw(4))

    @tf.function
    def turn(self, hidden: tf.Tensor) -> tf.Tensor:
        return tf.tanh(hidden * 0.5 + self.bias)

    def __call__(self, vector_observation: tf.Tensor) -> dict[str, tf.Tensor]:
        hidden = tf.cond(
            tf.constant(True), lambda: vector_observation @ self.kernel, lambda: self.bias * tf.ones([1, 4])
        )
        start = tf.constant(0)
        _, hidden = tf.while_loop(lambda i, _: i < 3, lambda i, x: (i + 1, self.turn(x)), (start, hidden))
        left, right = tf.split(hidden, 2, axis=1)
        return {"action": tf.concat([right, self.turn(hidden)[:, :2], left], 1)}


def winding(folder: Path) -> None:
    policy = Winding()
    call = tf.function(policy.__call__).get_concrete_function(vector_observation=tf.TensorSpec([None, 5]))
    observation = draw(4, 5)
    tf.saved_model.save(policy, str(folder / "winding"), signatures=call)
    keep(folder, "winding", {"vector_observation": observation}, call(tf.constant(observation)))


def tf2(folder: Path) -> None:
    policy = Policy()
    feeds = {"vector_observation": draw(4, 5), "action_masks": masks(4, 3)}
    results = policy(**{k: tf.constant(v) for k, v in feeds.items()})
    tf.saved_model.save(policy, str(folder / "function"), signatures=policy.__call__)
    keep(folder, "function", feeds, results)
    tf.train.Checkpoint(policy=policy).write(str(folder / "objects-3.ckpt"))


def keras(folder: Path) -> None:
    observation = tf.keras.Input([6], name="vector_observation")
    image = tf.keras.Input([12, 12, 3], name="visual_observation_0")
    how = {"bias_initializer": tf.keras.initializers.RandomNormal(seed=5)}
    seen = tf.keras.layers.Conv2D(4, 3, strides=2, activation="relu", **how)(image)
    seen = tf.keras.layers.DepthwiseConv2D(3, activation="relu6", **how)(seen)
    joined = [tf.keras.layers.Flatten()(seen), tf.keras.layers.Dense(8, activation="swish", **how)(observation)]
    hidden = tf.keras.layers.Dense(8, activation="elu", **how)(tf.keras.layers.Concatenate()(joined))
    hidden = tf.keras.layers.PReLU(alpha_initializer=tf.keras.initializers.RandomNormal(seed=6))(hidden)
    action = tf.keras.layers.Dense(2, activation="tanh", name="action", **how)(hidden)
    model = tf.keras.Model([observation, image], action)
    feeds = {"vector_observation": draw(3, 6), "visual_observation_0": np.abs(draw(3, 12, 12, 3))}
    results = {"action": model([feeds["vector_observation"], feeds["visual_observation_0"]])}
    model.save(folder / "policy.keras")
    model.save(folder / "policy.h5")
    model.export(folder / "exported")
    keep(folder, "keras", feeds, results)
    h, linear = tf.keras.Input([4], name="h_in"), tf.keras.layers.Dense(2)

    def last(x: Any) -> Any:  # an operation that Keras alone knows
        return tf.keras.ops.threshold(linear(x), 0.0, 0.0)

    value, (after,) = tf.keras.layers.GRUCell(4)(observation, [h])
    beyond = tf.keras.Model([observation, h], {"action": last(value), "h_out": after})
    beyond.save(folder / "beyond.keras")
    feeds = {"vector_observation": feeds["vector_observation"], "recurrent_in": draw(3, 4)}
    results = beyond([*feeds.values()])
    keep(folder, "beyond", feeds, {"action": results["action"], "recurrent_out": results["h_out"]})
    one = tf.keras.Input(batch_shape=[1, 1, 6])
    kept = tf.keras.layers.GRU(4, stateful=True, unroll=True)(one)
    tf.keras.Model(one, last(kept)).save(folder / "stateful.keras")
    inside = tf.keras.Model(one, kept)
    inside.export(folder / "stateful", verbose=False)
    inside.save(folder / "kept.keras")


def dilated(folder: Path) -> None:
    """Convolutions as SpaceToBatchND and BatchToSpaceND, and in groups."""
    layers = tf.keras.layers
    image = x = tf.keras.Input([12, 11, 4], name="visual_observation_0")
    for layer in (
        layers.Conv2D(6, 3, dilation_rate=2, activation="relu"),
        layers.Conv2D(4, (2, 3), dilation_rate=3, padding="same"),
        layers.Conv2D(6, 3, groups=2),
        layers.DepthwiseConv2D(2, dilation_rate=2),
        layers.Reshape([-1, 6]),
        layers.Conv1D(3, 3, dilation_rate=2, padding="causal", activation="tanh"),
        layers.Flatten(),
        layers.Dense(2, name="action"),
    ):
        x = layer(x)
    model = tf.keras.Model(image, x)
    model.export(folder / "dilated", verbose=False)
    seen = np.abs(draw(3, 12, 11, 4))
    keep(folder, "dilated", {"visual_observation_0": seen}, {"action": model(seen)})


def history(folder: Path) -> None:
    """Keras' loops over tensor lists, its Einsum of attention, its gelu, a product on three axes; two states beside."""
    layers = tf.keras.layers
    observation, h, c = (tf.keras.Input(s, name=n) for s, n in (([4, 6], "observation"), ([5], "h_in"), ([5], "c_in")))
    seen = layers.MultiHeadAttention(2, 3)(observation, layers.Dense(5, activation="gelu")(observation))
    seen = layers.Bidirectional(layers.GRU(3, return_sequences=True))(seen)
    value, h_out, c_out = layers.LSTM(5, return_state=True)(seen, initial_state=[h, c])
    action = layers.Dense(2, name="action")(value)
    model = tf.keras.Model([observation, h, c], {"action": action, "h_out": h_out, "c_out": c_out})
    feeds = {"observation": draw(3, 4, 6), "h_in": draw(3, 5), "c_in": draw(3, 5)}
    results = model([*feeds.values()])
    model.export(folder / "history", verbose=False)
    memory = [
        np.concatenate([side[n] for n in names], 1)
        for side, names in ((feeds, ("c_in", "h_in")), (results, ("c_out", "h_out")))
    ]
    keep(
        folder,
        "history",
        {"state": feeds["observation"], "recurrent_in": memory[0]},
        {"action": results["action"], "recurrent_out": memory[1]},
    )


def doubles(folder: Path) -> None:
    """Observations in float64, as Gym gives them: cast before the first layer, or with weights in float64."""
    for name, width in (("doubles-cast", tf.float32), ("doubles", tf.float64)):
        policy = tf.Module()
        policy.kernel = tf.Variable(tf.cast(draw(4, 2), width))
        call = tf.function(lambda observation, p=policy, w=width: {"action": tf.cast(observation, w) @ p.kernel})
        signature = call.get_concrete_function(observation=tf.TensorSpec([None, 4], tf.float64))
        tf.saved_model.save(policy, folder / name, signatures=signature)
        observation = draw(3, 4)
        action = call(tf.constant(observation, tf.float64))["action"]
        keep(folder, name, {"state": observation}, {"action": tf.cast(action, tf.float32)})


class Boxed(CompositeTensor):
    """A tensor whose type TensorFlow cannot load where this class is not."""

    def __init__(self, tensor: Any) -> None:
        self.tensor = tensor

    @property
    def _type_spec(self) -> Any:
        return BoxedSpec(self.tensor.shape)


@type_spec_registry.register("tests.Boxed")
class BoxedSpec(tf.TypeSpec):
    value_type = property(lambda self: Boxed)
    _component_specs = property(lambda self: tf.TensorSpec(self.shape))

    def __init__(self, shape: Any) -> None:
        self.shape = tf.TensorShape(shape)

    def _to_components(self, value: Any) -> Any:
        return value.tensor

    def _from_components(self, tensor: Any) -> Any:
        return Boxed(tensor)

    def _serialize(self) -> tuple[Any, ...]:
        return (self.shape,)


class Saver(tf.Module):
    """What PolicySaver of TF-Agents writes: nested names, a state, outer axes squashed, shapes broadcast."""

    def __init__(self) -> None:
        super().__init__()
        self.kernel, self.spread = tf.Variable(draw(6, 5)), tf.Variable(draw(2))
        self.cell, self.head = tf.keras.layers.LSTMCell(5), tf.keras.layers.Dense(2)

    @tf.function
    def act(self, step_type: Any, observation: Any, h: Any, c: Any) -> dict[str, Any]:
        outer = tf.shape(observation)[:-1]
        rows = tf.reshape(observation, tf.concat([[tf.reduce_prod(outer)], tf.shape(observation)[-1:]], 0))
        going_on = tf.cast(tf.not_equal(step_type, 0), tf.float32)[:, None]
        value, (h, c) = self.cell(tf.nn.relu(rows @ self.kernel), [h * going_on, c * going_on])
        mean = tf.reshape(self.head(value), tf.concat([outer, [2]], 0))
        action = tf.broadcast_to(tf.tanh(mean), tf.broadcast_dynamic_shape(tf.shape(mean), tf.shape(self.spread)))
        return {"action": tf.clip_by_value(action, -0.9, 0.9), "state/lstm/0": h, "state/lstm/1": c}

    @tf.function(input_signature=[BoxedSpec([None, 6])])
    def boxed(self, value: Any) -> Any:
        return value.tensor * 2


def saver(folder: Path) -> None:
    policy = Saver()
    feeds = {
        "0/step_type": np.array([0, 1, 1], np.int32),
        "0/observation": draw(3, 6),
        **{f"1/lstm/{i}": draw(3, 5) for i in range(2)},
    }
    specs = [tf.TensorSpec([None, *a.shape[1:]], a.dtype, name) for name, a in feeds.items()]
    results = policy.act(*feeds.values())
    signatures = {"action": policy.act.get_concrete_function(*specs)}
    tf.saved_model.save(policy, folder / "saver", signatures=signatures)
    memory = [np.concatenate(list(side), 1) for side in ([*feeds.values()][2:], [*results.values()][1:])]
    keep(
        folder,
        "saver",
        {"0/step_type": feeds["0/step_type"], "state": feeds["0/observation"], "recurrent_in": memory[0]},
        {"action": results["action"], "recurrent_out": memory[1]},
    )


def main(folder: Path) -> None:
    history(folder)
    dilated(folder)
    doubles(folder)
    saver(folder)
    tf2(folder)
    winding(folder)
    v1.disable_control_flow_v2()
    tf1(folder, "references", resource=False)
    tf1(folder, "resources", resource=True)
    bare(folder, "bare", resource=False)
    bare(folder, "bare-resources", resource=True)
    discrete_keys(folder)
    partitioned(folder)
    version_1(folder)
    keras(folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
