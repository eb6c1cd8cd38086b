"""export-model: trained Unity ML-Agents policies for every runtime, proven to act the same.

``from exporter import export_model, inspect_model, verify_bundle``. Nothing heavy is imported before it is used: a cold
start is a feature.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from exporter.version import __version__

if TYPE_CHECKING:
    from exporter.api import export_model, inspect_model, verify_bundle

__all__ = ["__version__", "export_model", "inspect_model", "verify_bundle"]


def __getattr__(name: str) -> Any:
    if name in ("export_model", "inspect_model", "verify_bundle"):
        from exporter import api

        return getattr(api, name)
    raise AttributeError(f"module 'exporter' has no attribute {name!r}")
