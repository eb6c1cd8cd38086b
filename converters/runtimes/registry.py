"""The runtimes that artefacts are verified in: a file per family, and here the list of them.

To add a runtime is to add a child process that speaks the frames of wire.py, and a line here. Nothing
here imports a runtime: ``import tensorflow`` takes seconds, and the question is only whether it is there.
"""

from __future__ import annotations

from converters.runtimes.base import Runtime, RuntimeInfo
from converters.runtimes.javascript.browser import (
    ONNXRUNTIME_WEB_CHROMIUM,
    TFJS_CPU_CHROMIUM,
    TFJS_WASM_CHROMIUM,
    TFJS_WEBGL,
)
from converters.runtimes.javascript.node import ONNXRUNTIME_WEB, TFJS_CPU, TFJS_WASM
from converters.runtimes.python import NUMPY, ONNXRUNTIME, TENSORFLOW
from converters.runtimes.tensorflow1.found import TF1_4, TF1_7

__all__ = ["RUNTIMES", "Runtime", "RuntimeInfo", "available_runtimes"]

#: In the order in which they are reported.
RUNTIMES: tuple[Runtime, ...] = (
    *(NUMPY, TENSORFLOW, TF1_4, TF1_7, ONNXRUNTIME, ONNXRUNTIME_WEB, TFJS_CPU, TFJS_WASM),
    *(TFJS_WEBGL, TFJS_CPU_CHROMIUM, TFJS_WASM_CHROMIUM, ONNXRUNTIME_WEB_CHROMIUM),
)


def available_runtimes() -> tuple[RuntimeInfo, ...]:
    """Every runtime by name, in the order in which they are reported, whether it is here or not."""
    return tuple(runtime.find() for runtime in RUNTIMES)
