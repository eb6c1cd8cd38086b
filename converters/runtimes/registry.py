"""The runtimes that artefacts are verified in: a folder per family, and here the list of them.

To add a runtime is to add a folder with a child process that speaks frames (frames.py) and a ``RUNTIMES`` that says
whether it is here, how its child is started and how it is installed; and its name here. Nothing here imports a runtime:
``import tensorflow`` takes seconds, and the question is only whether it is there.
"""

from __future__ import annotations

import importlib

from export_model.converters.runtimes.base import Runtime, RuntimeInfo

__all__ = ["RUNTIMES", "Runtime", "RuntimeInfo", "available_runtimes"]

#: Folders beside this file, in the order in which their runtimes are reported.
ROOMS = (
    "numpy",
    "tensorflow",
    "onnxruntime",
    "javascript",
    "litert",
    "c",
    "csharp",
    "node",
    "openvino",
    "torch",
)
RUNTIMES: tuple[Runtime, ...] = tuple(
    runtime
    for room in ROOMS
    for runtime in importlib.import_module(f"export_model.converters.runtimes.{room}").RUNTIMES
)


def available_runtimes() -> tuple[RuntimeInfo, ...]:
    """Every runtime by name, in the order in which they are reported, whether it is here or not."""
    return tuple(runtime.find() for runtime in RUNTIMES)
