"""The runtimes that artefacts are verified in: a file per family, and here the list of them.

To add a runtime is to add a child process that speaks the frames of converters/runner/wire.py, and a line here. Nothing
here imports a runtime: ``import tensorflow`` takes seconds, and the question is only whether it is there.
"""

from __future__ import annotations

from exporter.runtimes.base import Runtime, RuntimeInfo
from exporter.runtimes.javascript import TFJS_CPU, TFJS_WASM
from exporter.runtimes.python import NUMPY, ONNXRUNTIME, TENSORFLOW

__all__ = ["RUNTIMES", "Runtime", "RuntimeInfo", "available_runtimes"]

#: In the order in which they are reported.
RUNTIMES: tuple[Runtime, ...] = (NUMPY, TENSORFLOW, ONNXRUNTIME, TFJS_CPU, TFJS_WASM)


def available_runtimes() -> tuple[RuntimeInfo, ...]:
    """Every runtime by name, in the order in which they are reported, whether it is here or not."""
    return tuple(runtime.find() for runtime in RUNTIMES)
