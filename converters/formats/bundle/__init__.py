"""Bundles, and the contract that every artefact of them embeds."""

from export_model.converters.formats.format import Format

#: Its artefacts are read in its place (converters/formats/read.py).
BUNDLE = Format(key="bundle", label="a bundle of export-model", marker="policy.json")
FORMATS = (BUNDLE,)
