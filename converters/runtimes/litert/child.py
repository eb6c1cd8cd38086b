"""LiteRT in its own process: ``python -m converters.runtimes.litert.child``; told ``plain``, without XNNPACK.

A model is called by ``signature``, or by its tensors' own names where it has none, for as many agents as are fed.
"""

from __future__ import annotations

import importlib.metadata
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from converters.files.children.child import Model, claim_stdout, serve
from converters.files.children.frames import Tensors


def main() -> None:
    """Entry of the child process."""
    plain = sys.argv[1:] == ["plain"]
    out = claim_stdout()
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # before the import
    from ai_edge_litert import interpreter as litert

    kind = litert.OpResolverType
    resolver = kind.BUILTIN_WITHOUT_DEFAULT_DELEGATES if plain else kind.AUTO

    class Signed:
        """A model, called by one of its signatures, inputs by name."""

        def __init__(self, path: str, signature: str) -> None:
            self.keep = litert.Interpreter(path, num_threads=1, experimental_op_resolver_type=resolver)
            self.runner = self.keep.get_signature_runner(signature)

        def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
            results = self.runner(**feeds)
            return {name: results[name] for name in fetch}

    class Unsigned:
        """A model from before there were signatures."""

        def __init__(self, path: str) -> None:
            self.model = litert.Interpreter(path, num_threads=1, experimental_op_resolver_type=resolver)
            self.inputs = {found["name"]: found["index"] for found in self.model.get_input_details()}
            self.outputs = {found["name"]: found["index"] for found in self.model.get_output_details()}

        def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
            for name, array in feeds.items():
                self.model.resize_tensor_input(self.inputs[name], array.shape)
            self.model.allocate_tensors()
            for name, array in feeds.items():
                self.model.set_tensor(self.inputs[name], array)
            self.model.invoke()
            return {name: self.model.get_tensor(self.outputs[name]) for name in fetch}

    def load(header: Mapping[str, Any]) -> Model:
        signature = header.get("signature", "serving_default")
        return Signed(header["path"], signature) if signature else Unsigned(header["path"])

    serve("litert", importlib.metadata.version("ai-edge-litert"), load, (RuntimeError,), out)


if __name__ == "__main__":
    main()
