"""Barracuda's ``.nn`` models: read, and written (version 16) for Unity's ML-Agents of 0.7 to release 20."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from converters.format import Format, WriteOptions

if TYPE_CHECKING:
    from converters.content import Content
    from converters.fetch import Fetched
    from converters.pieces import Pieces
    from converters.policy import Policy
    from converters.source import ReadOptions, SourceModel
    from signatures.spec import PolicySignature

#: Versions of the format, an int64 at its beginning.
_VERSIONS = range(15, 21)


def _sniff(file: Content) -> bool:
    return len(file.data) >= 8 and struct.unpack_from("<q", file.data)[0] in _VERSIONS


def _read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    from converters.barracuda.source import read

    return read(given)


def _write(policy: Policy, options: WriteOptions) -> Mapping[str, Pieces]:
    from converters.barracuda.writer import write

    return write(policy, options)


def _answers(signature: PolicySignature) -> list[str]:
    from converters.barracuda.answers import answered

    return answered(signature)


def _held(path: Path) -> Any:
    from converters.barracuda.writer import contract_text

    return contract_text(path.read_bytes())


FORMATS = (
    Format(
        key="nn",
        label="a Barracuda .nn model",
        sniff=_sniff,
        read=_read,
        write=_write,
        main="{name}.nn",
        held=_held,
        runtimes=("numpy",),
        answers=_answers,
    ),
)
