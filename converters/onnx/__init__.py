"""ONNX models: read from every exporter that policies come from, and written."""

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
    """ModelProto begins with its version (1), and has a graph (7) or opsets (8)."""
    return bool(file.fields) and file.fields[0][:2] == (1, 0) and bool(file.numbers & {(7, 2), (8, 2)})


def _read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    from converters.onnx.source import read

    return read(given)


def _write(policy: Policy, options: WriteOptions) -> Mapping[str, Pieces]:
    from converters.onnx.writer import write

    return write(policy, options)


def _held(path: Path) -> Any:
    from converters.onnx.ports import held

    return held(path)


def _ports(path: Path) -> Ports:
    from converters.onnx.ports import ports

    return ports(path)


def _vetted(path: Path, wanted: Sequence[str], folder: Path) -> Path:
    from converters.onnx.vetted import vetted

    return vetted(path, wanted, folder)


def _inner(loaded: Loaded) -> AbstractContextManager[InnerTensors]:
    from converters.onnx.inner import inner

    return inner(loaded)


def _origins(path: Path) -> Mapping[str, str]:
    from converters.onnx.inner import origins

    return origins(path)


FORMATS = (
    Format(
        key="onnx",
        label="an ONNX model",
        sniff=_sniff,
        read=_read,
        write=_write,
        main="{name}.onnx",
        beside="{name}.onnx.data",
        default=True,
        narrow=True,
        held=_held,
        ports=_ports,
        vetted=_vetted,
        inner=_inner,
        origins=_origins,
        runtimes=("onnxruntime", "onnxruntime-web", "onnxruntime-web@chromium"),
    ),
)
