"""Keras models, which only TensorFlow itself can read."""

from __future__ import annotations

from typing import TYPE_CHECKING

from converters.format import Format

if TYPE_CHECKING:
    from converters.fetch import Fetched
    from converters.source import ReadOptions, SourceModel


def _read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    from converters.keras.source import read

    return read(given, options)


FORMATS = (
    Format(
        key="keras",
        label="a Keras model",
        sniff=lambda file: bool({"model.weights.h5", "config.json"} & {*file.entries}),
        read=_read,
    ),
    Format(
        key="hdf5",
        label="a Keras model in HDF5 (.h5)",
        sniff=lambda file: file.starts(b"\x89HDF"),
        read=_read,
    ),
)
