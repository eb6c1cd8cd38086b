"""Policies that live in a process with TensorFlow, exported from there: ``python -m tests.live.train FOLDER [CASE …]``.

A program of its own, so that a test process need not load TensorFlow. It plays the training script: it builds the
policy of each ``CASE`` (of all, where none is named), exports it to ``FOLDER/CASE/out`` in all formats, verified by
TensorFlow, and keeps in ``FOLDER/CASE/case.npz`` what was fed and what the session, function or model itself computed,
by canonical names. What must hold in this process (the graph is what it was, further exports are the first) is asserted
here.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

os.environ.update(TF_CPP_MIN_LOG_LEVEL="3", TF_ENABLE_ONEDNN_OPTS="0", CUDA_VISIBLE_DEVICES="-1")

import tensorflow as tf

from export_model.signatures.digest import sha256_hex
from tests.exporting import export_model
from tests.live.programs import shared_runtimes

RANDOM = np.random.default_rng(11)
BEGUN = RANDOM.bit_generator.state
v1 = tf.compat.v1
Arrays = Mapping[str, Any]


def draw(*shape: int) -> np.ndarray:
    return RANDOM.standard_normal(shape).astype(np.float32)


def masks(rows: int, width: int) -> np.ndarray:
    array = (RANDOM.random((rows, width)) < 0.6).astype(np.float32)
    array[:, 0] = 1
    return array


def keep(folder: Path, feeds: Arrays, results: Arrays) -> None:
    inputs = {f"in/{k}": np.asarray(v) for k, v in feeds.items()}
    np.savez(folder / "case.npz", **inputs, **{f"out/{k}": np.asarray(v) for k, v in results.items()})


def exported(folder: Path, **live: Any) -> None:
    """Export twice: verified, and into another folder, with the same bytes."""
    (result,) = export_model(out=folder / "out", verify=("tensorflow", "onnxruntime"), **live)
    assert result.report is not None
    assert (result.passed, result.report.reference) == (True, "source/tensorflow")
    for _ in range(3):
        (again,) = export_model(out=folder / "again", verify="none", **live)
        one, two = (json.loads((f / "policy.json").read_text()) for f in (result.folder, again.folder))
        assert one == two, (one, two)  # with the hashes of all files


# ------------------------------------------------------------------ sessions


def dense(x: Any, width: int, name: str, *, resource: bool) -> Any:
    with v1.variable_scope(name, use_resource=resource):
        kernel = v1.get_variable("kernel", initializer=draw(int(x.shape[-1]), width))
        bias = v1.get_variable("bias", initializer=draw(width))
    return tf.matmul(x, kernel) + bias


def constant(name: str, value: int) -> None:
    v1.get_variable(name, initializer=np.array(value, np.int32), trainable=False, use_resource=False)


def session_of(folder: Path, build: Callable[[], tuple[Arrays, Arrays, Any]], feeds: Arrays, **options: Any) -> None:
    """Build, train two steps, export; ``build`` gives canonical name → tensor of inputs and outputs, and the loss."""
    with tf.Graph().as_default() as graph, v1.Session() as session:
        inputs, outputs, loss = build()
        training = v1.train.AdamOptimizer(0.01).minimize(loss)
        v1.train.Saver()
        session.run(v1.global_variables_initializer())
        placed = {inputs[k]: v for k, v in feeds.items()}
        for _ in range(2):
            session.run(training, placed)
        graph.finalize()  # from here on, to add a node is an error
        before = sha256_hex(graph.as_graph_def().SerializeToString(deterministic=True)), graph.version
        exported(folder, session=session, **options)
        assert before == (sha256_hex(graph.as_graph_def().SerializeToString(deterministic=True)), graph.version)
        keep(folder, feeds, session.run(outputs, placed))


def continuous(*, resource: bool) -> tuple[Arrays, Arrays, Any]:
    observation = v1.placeholder(tf.float32, [None, 6], name="vector_observation")
    noise = v1.placeholder(tf.float32, [None, 2], name="epsilon")
    constant("version_number", 2)
    hidden = tf.nn.silu(dense(observation, 16, "hidden", resource=resource))  # leaves an IdentityN
    mu = dense(hidden, 2, "mu", resource=resource)
    sigma = v1.get_variable("log_sigma", initializer=draw(2), use_resource=resource)
    action = tf.identity(tf.clip_by_value(mu + tf.exp(sigma) * noise, -3, 3) / 3, name="action")
    value = tf.identity(dense(hidden, 1, "value", resource=resource), name="value_estimate")
    loss = tf.reduce_mean(tf.square(action) + tf.square(value))
    return {"state": observation, "epsilon": noise}, {"action": action, "value_estimate": value}, loss


def discrete() -> tuple[Arrays, Arrays, Any]:
    observation = v1.placeholder(tf.float32, [None, 5], name="vector_observation")
    allowed = v1.placeholder(tf.float32, [None, 5], name="action_masks")
    hidden = tf.nn.elu(dense(observation, 8, "hidden", resource=True))
    scores = []
    for i, (width, mask) in enumerate(zip((3, 2), tf.split(allowed, [3, 2], 1), strict=True)):
        kept = (tf.nn.softmax(dense(hidden, width, f"branch_{i}", resource=True)) + 1e-7) * mask
        scores.append(tf.math.log(kept / tf.reduce_sum(kept, 1, keepdims=True) + 1e-7))
    action = tf.concat(scores, 1, name="action")
    inputs = {"state": observation, "action_masks": allowed}
    return inputs, {"action": action}, tf.reduce_mean(tf.square(action))


def recurrent() -> tuple[Arrays, Arrays, Any]:
    """An LSTM over the sequence axis, in a while loop, as dynamic_rnn builds it: [c | h] is the memory."""
    units = 4
    observation = v1.placeholder(tf.float32, [None, 3], name="vector_observation")
    memory = v1.placeholder(tf.float32, [None, 2 * units], name="recurrent_in")
    length = v1.placeholder(tf.int32, [], name="sequence_length")
    constant("memory_size", 2 * units)
    sequence = tf.transpose(tf.reshape(observation, [-1, length, 3]), [1, 0, 2])
    kernel = v1.get_variable("kernel", initializer=draw(3 + units, 4 * units), use_resource=False)
    bias = v1.get_variable("bias", initializer=draw(4 * units), use_resource=False)

    def step(time: Any, c: Any, h: Any, out: Any) -> tuple[Any, ...]:
        gates = tf.matmul(tf.concat([seen.read(time), h], 1), kernel) + bias
        i, j, f, o = tf.split(gates, 4, 1)
        c = tf.sigmoid(f + 1.0) * c + tf.sigmoid(i) * tf.tanh(j)
        h = tf.sigmoid(o) * tf.tanh(c)
        return time + 1, c, h, out.write(time, h)

    seen = tf.TensorArray(tf.float32, size=length).unstack(sequence)
    start = (0, memory[:, :units], memory[:, units:], tf.TensorArray(tf.float32, size=length))
    _, c, h, out = tf.while_loop(lambda time, *_: time < length, step, start)
    hidden = tf.reshape(tf.transpose(out.stack(), [1, 0, 2]), [-1, units])
    action = tf.identity(tf.tanh(dense(hidden, 2, "mu", resource=False)), name="action")
    after = tf.concat([c, h], 1, name="recurrent_out")
    inputs = {"state": observation, "recurrent_in": memory, "sequence_length": length}
    return inputs, {"action": action, "recurrent_out": after}, tf.reduce_mean(tf.square(action))


def loops_of_1(folder: Path) -> None:
    feeds = {"state": draw(3, 3), "recurrent_in": draw(3, 8), "sequence_length": np.int32(1)}
    v1.disable_control_flow_v2()
    try:
        session_of(folder, recurrent, feeds)
    finally:
        v1.enable_control_flow_v2()


def looping() -> tuple[Arrays, Arrays, Any]:
    """A loop of TensorFlow 2 (a While that calls functions), and a call of a tf.function."""
    observation = v1.placeholder(tf.float32, [None, 3], name="vector_observation")
    kernel = v1.get_variable("kernel", initializer=draw(3, 3), use_resource=True)
    _, turned = tf.while_loop(lambda i, x: i < 3, lambda i, x: (i + 1, tf.tanh(tf.matmul(x, kernel))), (0, observation))
    squashed = tf.function(lambda x: tf.nn.elu(x) / 2, autograph=False)(turned)
    action = tf.identity(squashed, name="action")
    return {"state": observation}, {"action": action}, tf.reduce_mean(tf.square(action))


def unnamed() -> tuple[Arrays, Arrays, Any]:
    """Nothing is called as ML-Agents calls it: hints say what is what."""
    x = v1.placeholder(tf.float32, [None, 4], name="x")
    y = tf.tanh(dense(x, 2, "dense", resource=True), name="y")
    return {"state": x}, {"action": y}, tf.reduce_mean(y)


# ------------------------------------------------------------------ functions and Keras models


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
    def act(self, vector_observation: Any, action_masks: Any) -> dict[str, Any]:
        logits = tf.nn.silu(vector_observation @ self.kernel) @ self.head
        kept = (tf.nn.softmax(logits) + 1e-7) * action_masks
        return {"action": tf.math.log(kept / tf.reduce_sum(kept, 1, keepdims=True) + 1e-7)}


def function(folder: Path) -> None:
    policy = Policy()
    exported(folder, tf_function=policy.act)
    feeds = {"state": draw(4, 5), "action_masks": masks(4, 3)}
    keep(folder, feeds, policy.act(feeds["state"], feeds["action_masks"]))


def concrete(folder: Path) -> None:
    kernel = tf.Variable(draw(6, 2))

    @tf.function
    def steer(x: Any) -> Any:
        return tf.tanh(x @ kernel)

    feeds = {"state": draw(4, 6)}
    wanted = steer(feeds["state"])
    given = steer.get_concrete_function(tf.TensorSpec([None, 6], tf.float32, name="vector_observation"))
    exported(folder, tf_function=given, name="steering")
    keep(folder, feeds, {"action": wanted})


def keras(folder: Path) -> None:
    observation = tf.keras.Input([6], name="vector_observation")
    how = {"bias_initializer": tf.keras.initializers.RandomNormal(seed=5)}
    hidden = tf.keras.layers.Dense(8, activation="swish", **how)(observation)
    hidden = tf.keras.layers.Dropout(0.5)(tf.keras.layers.BatchNormalization()(hidden))
    action = tf.keras.layers.Dense(2, activation="tanh", name="action", **how)(hidden)
    value = tf.keras.layers.Dense(1, name="value_estimate", **how)(hidden)
    model = tf.keras.Model(observation, [action, value], name="walker")
    model.compile("adam", "mse")
    model.fit(draw(32, 6), [draw(32, 2), draw(32, 1)], epochs=1, verbose=0)
    exported(folder, keras_model=model)
    feeds = {"state": draw(3, 6)}
    keep(folder, feeds, dict(zip(("action", "value_estimate"), model(feeds["state"], training=False), strict=True)))


CASES: dict[str, Callable[[Path], None]] = {
    "continuous": lambda folder: session_of(
        folder, lambda: continuous(resource=False), {"state": draw(3, 6), "epsilon": draw(3, 2)}
    ),
    "resources": lambda folder: session_of(
        folder, lambda: continuous(resource=True), {"state": draw(3, 6), "epsilon": draw(3, 2)}, name="resources"
    ),
    "discrete": lambda folder: session_of(folder, discrete, {"state": draw(5, 5), "action_masks": masks(5, 5)}),
    "recurrent-loops_of_1": loops_of_1,
    "loop": lambda folder: session_of(folder, looping, {"state": draw(3, 3)}),
    "hints": lambda folder: session_of(
        folder, unnamed, {"state": draw(3, 4)}, inputs={"x": "vector_observation"}, outputs={"y": "action"}
    ),
    "function": function,
    "concrete": concrete,
    "keras": keras,
}


def main(folder: Path, cases: Sequence[str]) -> None:
    with shared_runtimes():
        for case in cases or CASES:
            RANDOM.bit_generator.state = BEGUN
            tf.keras.backend.clear_session()
            (folder / case).mkdir()
            CASES[case](folder / case)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
