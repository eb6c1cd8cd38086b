"""LiteRT in its own process: ``python -m export_model.converters.runtimes.litert.child``; ``plain``: without XNNPACK.

A model is called by ``signature``, or by its tensors' own names where it has none, for as many agents as are fed.
"""

from __future__ import annotations

import importlib.metadata
import math
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.files.children.child import Model, claim_stdout, serve
from export_model.converters.files.children.frames import Tensors

#: What a policy computes as float32.
WIDE = (np.float16, np.float64)


def main() -> None:
    """Entry of the child process."""
    plain = sys.argv[1:] == ["plain"]
    out = claim_stdout()
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # before the import
    from ai_edge_litert import interpreter as litert

    from export_model.converters.formats.litert.artifact import function_alone

    kind = litert.OpResolverType
    resolver = kind.BUILTIN_WITHOUT_DEFAULT_DELEGATES if plain else kind.AUTO

    def fitting(array: Any, shape: Sequence[int]) -> Sequence[int]:
        """The shape of a row as the model takes it: one for a single agent has no axis for more."""
        alone = array.ndim != len(shape) and array.size == math.prod(max(int(n), 1) for n in shape)
        return [max(int(n), 1) for n in shape] if alone else array.shape

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

    class Source:
        """A foreign model's ``function``, called for any tensor (``numbers``: by name; ``ports``: as callers say)."""

        def __init__(self, path: str, numbers: Mapping[str, int], ports: Mapping[str, int], function: int) -> None:
            self.model = litert.Interpreter(
                model_content=function_alone(Path(path), function, ports.values()),
                num_threads=1,
                experimental_op_resolver_type=resolver,
                experimental_preserve_all_tensors=True,
            )
            self.numbers = {**numbers, **ports}
            self.given = {found["index"]: found for found in self.model.get_input_details()}

        def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
            values = {self.numbers[name]: array for name, array in feeds.items()}
            for index, array in values.items():
                shape = fitting(array, self.given[index]["shape_signature"])
                values[index] = array.reshape(shape).astype(self.given[index]["dtype"])
                self.model.resize_tensor_input(index, shape)
            self.model.allocate_tensors()
            for index, array in values.items():
                self.model.set_tensor(index, array)
            self.model.invoke()
            found = {name: self.model.get_tensor(self.numbers[name]) for name in fetch}
            return {name: a.astype(np.float32) if a.dtype in WIDE else a for name, a in found.items()}

    def load(header: Mapping[str, Any]) -> Model:
        if "numbers" in header:
            return Source(header["path"], header["numbers"], header["ports"], header["function"])
        signature = header.get("signature", "serving_default")
        return Signed(header["path"], signature) if signature else Unsigned(header["path"])

    serve("litert", importlib.metadata.version("ai-edge-litert"), load, (RuntimeError,), out)


if __name__ == "__main__":
    main()
