"""Keras models, which only TensorFlow itself can read."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from export_model.converters.formats.keras import source as _source
else:
    (_source,) = defer_imports(__name__, "source")

FORMATS = (
    Format(
        key="keras",
        label="a Keras model",
        sniff=lambda file: bool({"model.weights.h5", "config.json"} & {*file.entries}),
        read=_source.read,
    ),
    Format(
        key="hdf5",
        label="a Keras model in HDF5 (.h5)",
        sniff=lambda file: file.starts(b"\x89HDF"),
        read=_source.read,
    ),
)
