"""The project's own JavaScript kernels in Node: what a page of one file runs (``kernels/``), which needs no package.

They read the TensorFlow.js artefact and compute as the numpy kernels do: in double, rounded once to float32.
"""

from __future__ import annotations

from pathlib import Path

from converters.runtimes.base import Runtime, RuntimeInfo
from converters.runtimes.javascript.node import INSTALL_NODE, node_command, node_executable

KERNELS = Path(__file__).resolve().parent / "kernels"
"""The modules that a page takes as well; ``model.mjs`` is the one to import."""

#: Of the kernels: higher wherever one computes otherwise.
_VERSION = "1"


def _find() -> RuntimeInfo:
    here = node_executable() is not None
    return RuntimeInfo("js", here, _VERSION if here else None, INSTALL_NODE)


def _command() -> list[str]:
    return node_command(KERNELS.with_name("runner.mjs"), _VERSION)


RUNTIMES = (
    Runtime(
        *("js", _find, _command),
        independent=False,
        products_per_second=2e8,
        taken_by="full",
    ),
)
