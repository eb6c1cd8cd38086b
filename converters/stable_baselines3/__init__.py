"""Saved models of Stable-Baselines3 and sb3-contrib (``.zip``), and their unpacked folders."""

from __future__ import annotations

from typing import TYPE_CHECKING

from converters.format import Format

if TYPE_CHECKING:
    from converters.fetch import Fetched
    from converters.source import ReadOptions, SourceModel


def _read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    from converters.stable_baselines3.source import read

    return read(given, options)


FORMATS = (
    Format(
        key="stable_baselines3",
        label="a saved model of Stable-Baselines3 (.zip)",
        sniff=lambda file: {"data", "policy.pth"} <= set(file.entries),
        marker="policy.pth",
        read=_read,
        takes=frozenset({"activation"}),
    ),
)
