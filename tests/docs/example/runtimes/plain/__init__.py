"""Steps in plain Python."""

from __future__ import annotations

import platform
from functools import partial

from export_model.converters.files.children.python import child_command
from export_model.converters.runtimes.base import Runtime, RuntimeInfo


def _find() -> RuntimeInfo:
    return RuntimeInfo("plain", True, platform.python_version(), "it comes with Python")


RUNTIMES = (
    Runtime("plain", _find, partial(child_command, "export_model.converters.runtimes.plain.child"), independent=False),
)
