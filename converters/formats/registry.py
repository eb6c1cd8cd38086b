"""The list of rooms: all that there is to register. A room's ``FORMATS`` say what it reads and writes, and how."""

from __future__ import annotations

import importlib
from collections.abc import Collection

from export_model.converters.formats.format import Format
from export_model.signatures.errors import UsageError, suggestion

#: Packages of ``converters``, in the order in which formats are recognised, written and reported.
ROOMS = (
    "bundle",
    "checkpoint",
    "frozen_graph",
    "saved_model",
    "tfjs",
    "onnx",
    "barracuda",
    "litert",
    "c",
    "csharp",
    "js",
    "stable_baselines3",
    "rllib",
    "brax",
    "torchscript",
    "torch_checkpoint",
    "keras",
)
FORMATS: tuple[Format, ...] = tuple(
    found for room in ROOMS for found in importlib.import_module(f"export_model.converters.formats.{room}").FORMATS
)
#: What can be written, by key; and what is, where nobody says what.
WRITTEN = {f.key: f for f in FORMATS if f.write is not None}
DEFAULTS = tuple(f.key for f in WRITTEN.values() if f.default)
#: The runtime that is our own kernels.
KERNELS = "numpy"
#: Those that other rooms mean by what they are: what the numpy kernels run, pages load, Unity imports and compiles,
#: boards run.
FROZEN_GRAPH, SAVED_MODEL, TFJS, ONNX, BARRACUDA, CSHARP, LITERT = (
    WRITTEN[key] for key in ("bytes", "saved_model", "tfjs", "onnx", "nn", "csharp", "litert")
)


def format_for_writing(key: str) -> Format:
    """The format of a word of ``--to``, its key or an alias. Raises UsageError."""
    key = next((f.key for f in WRITTEN.values() if key in f.aliases), key)
    if key not in WRITTEN:
        raise UsageError(
            f"--to {key}: unknown format",
            fix=f"{suggestion(key, WRITTEN)}the formats are {', '.join(WRITTEN)}",
        )
    return WRITTEN[key]


def narrows(key: str) -> bool:
    """Whether a format lacks dtypes; ``key`` may name a signature (``saved_model:deterministic``)."""
    found = WRITTEN.get(key.partition(":")[0])
    return found is not None and bool(found.dtypes)


def own_reference(keys: Collection[str]) -> Format | None:
    """The first of a bundle's formats that the numpy kernels run: what it is verified against without its source."""
    return next((f for f in WRITTEN.values() if f.key in keys and KERNELS in f.runtimes), None)
