"""PyTorch checkpoints (``.pt``): of ML-Agents, rsl_rl, CleanRL."""

from __future__ import annotations

from typing import TYPE_CHECKING

from converters.format import Format

if TYPE_CHECKING:
    from converters.content import Content
    from converters.fetch import Fetched
    from converters.source import ReadOptions, SourceModel


def _sniff(file: Content) -> bool:
    """A pickle, alone or in an archive."""
    return file.starts(b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05") or any(
        name.endswith("data.pkl") for name in file.entries
    )


def _read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    from converters.torch_checkpoint.source import read

    return read(given, options)


FORMATS = (
    Format(
        key="torch_checkpoint",
        label="a PyTorch checkpoint (.pt)",
        sniff=_sniff,
        read=_read,
        takes=frozenset({"sensors", "activation"}),
    ),
)
