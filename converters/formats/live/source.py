"""A live object to a model: its graph, frozen, and a copy in a folder from which TensorFlow runs the original."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from msgspec import Struct

from export_model.converters.formats.format import Format
from export_model.converters.formats.live.functions import read_function, read_keras
from export_model.converters.formats.live.session import read_session
from export_model.converters.formats.source import SourceModel
from export_model.converters.graph.nodes import Graph
from export_model.signatures.digest import sha256_hex
from export_model.signatures.errors import UsageError

_KINDS = {
    "session": (Format(key="session", label="a live session"), read_session),
    "tf_function": (Format(key="tf_function", label="a live tf.function"), read_function),
    "keras_model": (Format(key="keras_model", label="a live Keras model"), read_keras),
}


class Live(Struct, frozen=True):
    """What was read of a live object. ``sha256`` and ``size`` (bytes) are those of its frozen graph."""

    format: Format
    model: SourceModel
    sha256: str
    size: int


def label(kind: str) -> str:
    """What stands where other sources have a path, for a live object of a kind."""
    return _KINDS[kind][0].label.removeprefix("a ")


def read_live(kind: str, given: object, folder: Path) -> Live:
    """Read ``given``, which is of a kind in ``_KINDS``; neither it nor its graph is changed.

    ``folder`` is empty and stays until the export is verified: what TensorFlow needs to run the original is written
    there. Raises UsageError for an object of another kind, SourceError and what a frozen graph raises.
    """
    found, read = _KINDS[kind]
    tensorflow = sys.modules.get("tensorflow")
    if tensorflow is None:
        raise UsageError(
            f"{kind} is {type(given).__name__}, and TensorFlow is not loaded",
            why="a live object of TensorFlow comes from a process that has imported it",
            fix="give a file or a folder as the source instead",
        )
    model = read(tensorflow, given, folder)
    data = b"".join(_content(model.graph))
    return Live(found, model, sha256_hex(data), len(data))


def _content(graph: Graph) -> Iterator[bytes]:
    """A graph as bytes, the same in every process: TensorFlow's own form numbers its functions by the process."""
    for node in graph.nodes:
        attrs: list[tuple[str, Any]] = [(key, str(node.attrs[key])) for key in sorted(node.attrs)]
        yield repr((node.name, node.op, node.inputs, attrs)).encode()
        if node.value is not None:
            yield repr((node.value.dtype.str, node.value.shape)).encode()
            yield node.value.tobytes()
