"""TensorFlow in its own process: frozen graphs in a Session, SavedModels through a signature.

``python -m converters.runner.tensorflow_child``
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from converters.runner.child import Model, claim_stdout, serve
from converters.runner.wire import Tensors


def main() -> None:
    """Entry of the child process."""
    out = claim_stdout()
    # Before the import: no log lines, no oneDNN (it changes rounding), one thread, no search for a GPU.
    os.environ.update(TF_CPP_MIN_LOG_LEVEL="3", TF_ENABLE_ONEDNN_OPTS="0", CUDA_VISIBLE_DEVICES="-1")
    import tensorflow as tf  # noqa: TID251  this is the child process

    tf.config.threading.set_intra_op_parallelism_threads(1)
    tf.config.threading.set_inter_op_parallelism_threads(1)

    class Frozen:
        """A GraphDef in a Session; feeds and fetches are tensor names, inner ones too."""

        def __init__(self, path: str) -> None:
            definition = tf.compat.v1.GraphDef.FromString(Path(path).read_bytes())
            graph = tf.Graph()
            with graph.as_default():
                tf.import_graph_def(definition, name="")
            self.session = tf.compat.v1.Session(graph=graph)

        def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
            values = self.session.run(
                [_tensor(n) for n in fetch], {_tensor(name): array for name, array in feeds.items()}
            )
            return dict(zip(fetch, values, strict=True))

    class Saved:
        """A SavedModel, called as TensorFlow 2 does: one signature, inputs by name."""

        def __init__(self, path: str, signature: str) -> None:
            self.keep = tf.saved_model.load(path)
            self.function = self.keep.signatures[signature]

        def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
            results = self.function(**{name: tf.constant(array) for name, array in feeds.items()})
            return {name: results[name].numpy() for name in fetch}

    def load(header: Mapping[str, Any]) -> Model:
        if header["kind"] == "saved_model":
            return Saved(header["path"], header.get("signature", "serving_default"))
        return Frozen(header["path"])

    serve("tensorflow", tf.__version__, load, (tf.errors.OpError, AttributeError, RuntimeError), out)


def _tensor(name: str) -> str:
    return name if ":" in name else f"{name}:0"


if __name__ == "__main__":
    main()
