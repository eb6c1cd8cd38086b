"""Frozen TensorFlow graphs (GraphDef): read from ``.bytes`` and ``.pb``, and written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from converters.format import Format, Ports, WriteOptions

if TYPE_CHECKING:
    from converters.fetch import Fetched
    from converters.inner import InnerTensors, Loaded
    from converters.pieces import Pieces
    from converters.policy import Policy
    from converters.source import ReadOptions, SourceModel


def _read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    from converters.frozen_graph.source import read

    return read(given)


def _write(policy: Policy, options: WriteOptions) -> Mapping[str, Pieces]:
    from converters.frozen_graph.writer import write

    return write(policy, options)


def _ports(path: Path) -> Ports:
    from converters.frozen_graph.ports import ports

    return ports(path)


def _vetted(path: Path, wanted: Sequence[str], folder: Path) -> Path:
    from converters.frozen_graph.vetted import vetted

    return vetted(path, wanted, folder)


def _inner(loaded: Loaded) -> AbstractContextManager[InnerTensors]:
    from converters.frozen_graph.inner import inner

    return inner(loaded)


FORMATS = (
    Format(
        key="bytes",
        label="a TensorFlow graph (GraphDef)",
        sniff=lambda file: file.is_graph,
        read=_read,
        write=_write,
        main="{name}.bytes",
        default=True,
        narrow=True,
        ports=_ports,
        vetted=_vetted,
        inner=_inner,
        runtimes=("numpy", "tensorflow", "tf1.4", "tf1.7"),
    ),
)
