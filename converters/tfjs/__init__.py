"""TensorFlow.js models: graphs read from any converter, and written; layers models read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from converters.format import Format, Ports, WriteOptions

if TYPE_CHECKING:
    from converters.fetch import Fetched
    from converters.inner import InnerTensors, Loaded
    from converters.pieces import Pieces
    from converters.policy import Policy
    from converters.source import ReadOptions, SourceModel


def _is_folder_of_one(path: Path) -> bool:
    from converters.tfjs.reader import model_file

    return path.is_dir() and model_file(path).is_file()


def _read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    from converters.tfjs.source import read

    return read(given)


def _write(policy: Policy, options: WriteOptions) -> Mapping[str, Pieces]:
    from converters.tfjs.writer import write

    return write(policy, options)


def _held(path: Path) -> Any:
    from converters.tfjs.reader import held

    return held(path)


def _ports(path: Path) -> Ports:
    from converters.tfjs.ports import ports

    return ports(path)


def _vetted(path: Path, wanted: Sequence[str], folder: Path) -> Path:
    from converters.tfjs.vetted import vetted

    return vetted(path, wanted, folder)


def _inner(loaded: Loaded) -> AbstractContextManager[InnerTensors]:
    from converters.tfjs.inner import inner

    return inner(loaded)


FORMATS = (
    Format(
        key="tfjs",
        label="a TensorFlow.js model",
        sniff=lambda file: "modelTopology" in (file.json or {}),
        marker="model.json",
        at=_is_folder_of_one,
        read=_read,
        write=_write,
        main="tfjs",
        default=True,
        narrow=True,
        held=_held,
        ports=_ports,
        vetted=_vetted,
        inner=_inner,
        runtimes=(
            *("tfjs-cpu", "tfjs-wasm", "tfjs-webgl"),
            *("tfjs-cpu@chromium", "tfjs-wasm@chromium"),
            "js",
        ),
        predicts=True,
        dtypes=frozenset({"float32", "int32", "bool"}),
    ),
)
