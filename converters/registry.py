"""Which room reads and writes which format. To add a format is to add a room and a line here."""

from __future__ import annotations

import importlib
from types import MappingProxyType

from converters.artifact import Writer
from converters.source import Reader
from signatures.errors import UsageError

#: Target on the command line → module whose ``write`` makes it.
WRITERS = MappingProxyType(
    {
        "bytes": "converters.frozen_graph.writer",
        "saved_model": "converters.saved_model.writer",
        "tfjs": "converters.tfjs.writer",
        "onnx": "converters.onnx.writer",
    }
)
TARGETS = tuple(WRITERS)

#: Kind of file or folder (converters/recognise.py) → module whose ``read`` takes it.
READERS = MappingProxyType(
    {
        "frozen_graph": "converters.frozen_graph.source",
        "nn": "converters.barracuda.source",
        "onnx": "converters.onnx.source",
        "raw_graph": "converters.checkpoint.source",
        "meta_graph": "converters.checkpoint.source",
        "checkpoint": "converters.checkpoint.source",
        "run_folder": "converters.checkpoint.run_folder",
        "saved_model": "converters.saved_model.source",
        "keras": "converters.saved_model.keras",
        "hdf5": "converters.saved_model.keras",
        "tfjs": "converters.tfjs.source",
        "torch_checkpoint": "converters.torch_checkpoint.source",
        "bundle": "converters.bundle.source",
    }
)


def reader(kind: str) -> Reader | None:
    """The reader of a kind of file, None where there is none; its module is imported here."""
    if kind not in READERS:
        return None
    read: Reader = importlib.import_module(READERS[kind]).read
    return read


def writer(target: str) -> Writer:
    """The writer of a target; its module is imported here, not before. Raises UsageError."""
    if target not in WRITERS:
        import difflib

        close = difflib.get_close_matches(target, TARGETS, n=1)
        raise UsageError(
            f"--to {target}: there is no such format",
            fix=(f"did you mean {close[0]}? " if close else "") + f"the formats are {', '.join(TARGETS)}",
        )
    write: Writer = importlib.import_module(WRITERS[target]).write
    return write
