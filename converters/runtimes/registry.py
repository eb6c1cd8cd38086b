"""The runtimes that artefacts are verified in: a file per family, and here the list of them.

To add a runtime is to add a child process that speaks the frames of converters/runner/wire.py, and a line here. Nothing
here imports a runtime: ``import tensorflow`` takes seconds, and the question is only whether it is there.
"""

from __future__ import annotations

from exporter.runtimes.base import Runtime, RuntimeInfo
from exporter.runtimes.browser import ONNXRUNTIME_WEB_CHROMIUM, TFJS_CPU_CHROMIUM, TFJS_WASM_CHROMIUM, TFJS_WEBGL
from exporter.runtimes.javascript import ONNXRUNTIME_WEB, TFJS_CPU, TFJS_WASM
from exporter.runtimes.legacy import TF1_4, TF1_7
from exporter.runtimes.python import NUMPY, ONNXRUNTIME, TENSORFLOW

__all__ = ["RUNTIMES", "Runtime", "RuntimeInfo", "available_runtimes"]

#: In the order in which they are reported.
RUNTIMES: tuple[Runtime, ...] = (
    *(NUMPY, TENSORFLOW, TF1_4, TF1_7, ONNXRUNTIME, ONNXRUNTIME_WEB, TFJS_CPU, TFJS_WASM),
    *(TFJS_WEBGL, TFJS_CPU_CHROMIUM, TFJS_WASM_CHROMIUM, ONNXRUNTIME_WEB_CHROMIUM),
)


def available_runtimes() -> tuple[RuntimeInfo, ...]:
    """Every runtime by name, in the order in which they are reported, whether it is here or not."""
    return tuple(runtime.find() for runtime in RUNTIMES)
