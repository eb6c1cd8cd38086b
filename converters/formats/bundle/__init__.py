"""Bundles, and the contract that every artefact of them embeds."""

from converters.formats.format import Format

#: Its artefacts are read in its place (converters/formats/read.py).
BUNDLE = Format(key="bundle", label="a bundle of export-model", marker="policy.json")
FORMATS = (BUNDLE,)
