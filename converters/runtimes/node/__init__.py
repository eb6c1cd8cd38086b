"""Node: runs ES modules that were written without a runtime."""

from __future__ import annotations

from pathlib import Path

from export_model.converters.runtimes.base import OWN_WORDS, Runtime, RuntimeInfo
from export_model.converters.runtimes.javascript.node import INSTALL_NODE, node_command, node_executable

_RUNNER = Path(__file__).resolve().with_name("runner.mjs")


def _find() -> RuntimeInfo:
    return RuntimeInfo("node", node_executable() is not None, None, INSTALL_NODE)


def _command() -> list[str]:
    return node_command(_RUNNER)


RUNTIMES = (Runtime("node", _find, _command, products_per_second=2e8, own_words=OWN_WORDS),)
