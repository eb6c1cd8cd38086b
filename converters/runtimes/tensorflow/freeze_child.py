"""TensorFlow freezing what cannot be read without it: ``python -m converters.runtimes.tensorflow.freeze_child``.

A Keras model is loaded by ``path``, if it is made of Keras' own layers; run, it gives its GraphDef's bytes as ``graph``
and a JSON object of its inputs' and outputs' tensors as ``names``, both as bytes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from converters.keras.config import config_inside, refuse_code
from converters.runtimes.child import claim_stdout, serve
from converters.runtimes.tensorflow.freeze import FrozenFunction, frozen_function
from converters.runtimes.wire import Tensors
from signatures.errors import ExportModelError


class _Frozen:
    def __init__(self, function: FrozenFunction) -> None:
        self.function = function

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        function = self.function
        names = {"inputs": function.inputs, "outputs": function.outputs, "signature": function.signature}
        graph = function.graph_def.SerializeToString(deterministic=True)
        return {name: np.frombuffer(data, np.uint8) for name, data in
                (("graph", graph), ("names", json.dumps(names).encode()))}  # fmt: skip


def main() -> None:
    """Entry of the child process."""
    out = claim_stdout()
    os.environ.update(TF_CPP_MIN_LOG_LEVEL="3", TF_ENABLE_ONEDNN_OPTS="0", CUDA_VISIBLE_DEVICES="-1")
    import tensorflow as tf  # noqa: TID251  this is the child process

    def load(header: Mapping[str, Any]) -> _Frozen:
        refuse_code(config_inside(header["path"]))
        return _Frozen(frozen_function(header["path"], "keras"))

    faults = (tf.errors.OpError, AttributeError, RuntimeError, ImportError, ExportModelError)
    serve("tensorflow", tf.__version__, load, faults, out)


if __name__ == "__main__":
    main()
