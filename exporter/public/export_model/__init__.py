"""export-model: trained policies for every runtime, proven to act the same.

``export`` writes a policy in every format and compares them, ``load`` gives one that acts, ``inspect`` shows what is in
a file, ``verify`` checks a bundle again, ``compare`` checks files of any tool, ``play`` compares what they earn in an
environment. What they need is imported when they are called.
"""

from __future__ import annotations

import importlib

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from exporter import __version__
    from exporter.interface import compare, export, inspect, load, play, verify
    from exporter.options import ReadOptions, WriteOptions
    from exporter.play.options import PlayOptions
    from exporter.verify.options import VerifyOptions
    from signatures.errors import ExportModelError, ParityError

_HOMES = {
    **dict.fromkeys(("compare", "export", "inspect", "load", "play", "verify"), "exporter.interface"),
    **dict.fromkeys(("ReadOptions", "WriteOptions"), "exporter.options"),
    "PlayOptions": "exporter.play.options",
    "VerifyOptions": "exporter.verify.options",
    **dict.fromkeys(("ExportModelError", "ParityError"), "signatures.errors"),
    "__version__": "exporter",
}

__all__ = [
    "ExportModelError",
    "ParityError",
    "PlayOptions",
    "ReadOptions",
    "VerifyOptions",
    "WriteOptions",
    "__version__",
    "compare",
    "export",
    "inspect",
    "load",
    "play",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'export_model' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
