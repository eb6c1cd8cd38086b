"""What export_model refuses of live objects: ``python -m tests.live.refusals FOLDER``, a JSON object of the errors.

A program of its own, as ``train``. Nothing may be left in ``FOLDER``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from export_model.signatures.errors import ExportModelError
from tests.exporting import export_model
from tests.live.train import Policy, dense, draw, tf, v1  # first: it sets up TensorFlow


def policy() -> Any:
    x = v1.placeholder(tf.float32, [None, 3], name="vector_observation")
    return tf.identity(dense(x, 2, "dense", resource=True), name="action")


def session(*, initialised: bool = True, closed: bool = False) -> Any:
    with tf.Graph().as_default() as graph:
        policy()
        opened = v1.Session(graph=graph)
        if initialised:
            opened.run(v1.global_variables_initializer())
        if closed:
            opened.close()
        return opened


def without_policy() -> Any:
    with tf.Graph().as_default() as graph:
        a = v1.placeholder(tf.float32, [None, 3], name="a")
        tf.add(a, 1, name="b"), tf.exp(a, name="c")
        return v1.Session(graph=graph)


def traced(*widths: int) -> Any:
    function = tf.function(lambda x: x * 2, autograph=False)
    for width in widths:
        function(tf.constant(draw(2, width)))
    return function


class Subclass(tf.keras.Model):
    def call(self, x: Any) -> Any:
        return x * 2


def of_strings() -> Any:
    return tf.function(
        lambda x: tf.strings.length(x), input_signature=[tf.TensorSpec([None], tf.string)], autograph=False
    )


def of_no_tensors() -> Any:
    return tf.function(
        lambda x: {"action": x, "inner": {"a": x}}, input_signature=[tf.TensorSpec([None, 2])], autograph=False
    )


def one_row() -> Any:
    spec = tf.TensorSpec([1, 2], name="vector_observation")
    return tf.function(lambda x: x * 2, input_signature=[spec], autograph=False)


CASES: dict[str, Callable[[], dict[str, Any]]] = {
    "no session": lambda: {"session": tf.Graph()},
    "closed": lambda: {"session": session(closed=True)},
    "not initialised": lambda: {"session": session(initialised=False)},
    "without a policy": lambda: {"session": without_policy()},
    "a session and a function": lambda: {"session": session(), "tf_function": Policy().act},
    "a step": lambda: {"session": session(), "step": 3},
    "no function": lambda: {"tf_function": Policy.act.python_function},
    "never traced": lambda: {"tf_function": traced()},
    "traced twice": lambda: {"tf_function": traced(2, 3)},
    "strings": lambda: {"tf_function": of_strings()},
    "nested": lambda: {"tf_function": of_no_tensors()},
    "called once": lambda: {"tf_function": traced(2)},
    "one row": lambda: {"tf_function": one_row()},
    "no model": lambda: {"keras_model": tf.keras.layers.Dense(2)},
    "a subclass": lambda: {"keras_model": Subclass()},
    "never built": lambda: {"keras_model": tf.keras.Sequential([tf.keras.layers.Dense(2)])},
}


def refusal(folder: Path, **live: Any) -> dict[str, Any] | None:
    try:
        export_model(out=folder / "out", verify="none", **live)
    except ExportModelError as error:
        return error.to_dict()
    return None


def main(folder: Path) -> None:
    said = {name: refusal(folder, **make()) for name, make in CASES.items()}
    act = Policy().act
    with tf.Graph().as_default():
        said["in a graph"] = refusal(folder, tf_function=act)
    v1.disable_eager_execution()
    said["eager execution is off"] = refusal(folder, tf_function=act)
    print(json.dumps(said))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
