"""export-model: trained policies for every runtime, proven to act the same.

``import export_model`` is what users import; ``from export_model.exporter import …`` has the same with flat keywords.
Nothing heavy is imported before it is used: a cold start is a feature.
"""

from __future__ import annotations

import importlib

if __name__ != "export_model.exporter":
    raise ImportError("import it as export_model.exporter: only what holds export_model belongs on sys.path")

#: pyproject.toml reads it from here.
__version__ = "0.1.0"

# As typing has it, whose import is a third of what is done before an interrupt is answered (exporter/cli/__init__.py).
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from export_model.exporter.acting.loading import load_policy
    from export_model.exporter.api import compare_artefacts, export_model, inspect_model, verify_bundle

__all__ = ["__version__", "compare_artefacts", "export_model", "inspect_model", "load_policy", "verify_bundle"]

_HOMES = {"load_policy": "export_model.exporter.acting.loading"}


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(importlib.import_module(_HOMES.get(name, "export_model.exporter.api")), name)
    raise AttributeError(f"module 'exporter' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
