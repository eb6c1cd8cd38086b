"""export-model: trained policies for every runtime, proven to act the same.

``export`` writes a policy in every format and compares them, ``load`` gives one that acts, ``inspect`` shows what is in
a file, ``verify`` checks a bundle again, ``compare`` checks files of any tool, ``play`` compares what they earn in an
environment. What they need is imported when they are called. Every error is one of these names.
"""

from __future__ import annotations

import importlib

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from export_model.converters.files.children.process import RunFailedError
    from export_model.exporter import __version__
    from export_model.exporter.interface import compare, export, inspect, load, play, verify
    from export_model.exporter.options import ReadOptions, WriteOptions
    from export_model.exporter.play.options import PlayOptions
    from export_model.exporter.verify.options import VerifyOptions
    from export_model.signatures.errors import (
        BundleError,
        DamagedFileError,
        ExportModelError,
        GraphError,
        NotAPolicyError,
        ParityError,
        ProfileError,
        RefusedError,
        RuntimeUnavailableError,
        SignatureError,
        SourceError,
        TooLargeError,
        UnsupportedOpError,
        UsageError,
    )

_ERRORS = (
    "BundleError",
    "DamagedFileError",
    "ExportModelError",
    "GraphError",
    "NotAPolicyError",
    "ParityError",
    "ProfileError",
    "RefusedError",
    "RuntimeUnavailableError",
    "SignatureError",
    "SourceError",
    "TooLargeError",
    "UnsupportedOpError",
    "UsageError",
)
_HOMES = {
    **dict.fromkeys(("compare", "export", "inspect", "load", "play", "verify"), "export_model.exporter.interface"),
    **dict.fromkeys(("ReadOptions", "WriteOptions"), "export_model.exporter.options"),
    "PlayOptions": "export_model.exporter.play.options",
    "VerifyOptions": "export_model.exporter.verify.options",
    **dict.fromkeys(_ERRORS, "export_model.signatures.errors"),
    "RunFailedError": "export_model.converters.files.children.process",
    "__version__": "export_model.exporter",
}

__all__ = [
    "BundleError",
    "DamagedFileError",
    "ExportModelError",
    "GraphError",
    "NotAPolicyError",
    "ParityError",
    "PlayOptions",
    "ProfileError",
    "ReadOptions",
    "RefusedError",
    "RunFailedError",
    "RuntimeUnavailableError",
    "SignatureError",
    "SourceError",
    "TooLargeError",
    "UnsupportedOpError",
    "UsageError",
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
