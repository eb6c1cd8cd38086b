"""SavedModels: of TensorFlow 1 and 2 read, and written with ``serving_default``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from converters.format import Format, Ports, WriteOptions

if TYPE_CHECKING:
    from converters.content import Content
    from converters.fetch import Fetched
    from converters.inner import InnerTensors, Loaded
    from converters.pieces import Pieces
    from converters.policy import Policy
    from converters.source import ReadOptions, SourceModel


def _sniff(file: Content) -> bool:
    """It begins with its version (1), which is 1, and graphs (2); an ONNX model has fields 7 and 8 beside them."""
    if [field[:2] for field in file.fields[:2]] != [(1, 0), (2, 2)] or file.numbers & {(7, 2), (8, 2)}:
        return False
    return bytes(file.fields[0][2]) == b"\x01"


def _read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    from converters.saved_model.source import read

    return read(given)


def _write(policy: Policy, options: WriteOptions) -> Mapping[str, Pieces]:
    from converters.saved_model.writer import write

    return write(policy, options)


def _held(path: Path) -> Any:
    from converters.saved_model.source import held

    return held(path)


def _ports(path: Path) -> Ports:
    from converters.saved_model.ports import ports

    return ports(path)


def _vetted(path: Path, wanted: Sequence[str], folder: Path) -> Path:
    from converters.saved_model.vetted import vetted

    return vetted(path, wanted, folder)


def _inner(loaded: Loaded) -> AbstractContextManager[InnerTensors]:
    from converters.saved_model.inner import inner

    return inner(loaded)


FORMATS = (
    Format(
        key="saved_model",
        label="a SavedModel",
        sniff=_sniff,
        marker="saved_model.pb",
        read=_read,
        write=_write,
        main="saved_model",
        default=True,
        narrow=True,
        held=_held,
        ports=_ports,
        vetted=_vetted,
        inner=_inner,
        runtimes=("tensorflow",),
        signatures=True,
    ),
)
