"""Fixtures as bundles, and what is printed for them."""

from __future__ import annotations

import shutil
from pathlib import Path

from msgspec.structs import replace

from export_model.converters.formats.registry import DEFAULTS
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.snippets.contract import SnippetBundle, read_bundle
from export_model.exporter.snippets.registry import snippets
from fixtures import path as fixture
from tests.exporting import export_model

KINDS = ("continuous", "discrete", "sampled", "recurrent", "visual", "twobrains")
NAMES = (*KINDS[:-1], "twobrains-StrikerBrain", "twobrains-Goalie-Brain-2", "own-names-Goalie-Brain-2")


def bundle_of(out: Path, name: str) -> SnippetBundle:
    """The bundle as it is seen from ``out``."""
    return replace(read_bundle(out / name), folder=Path(name))


def code_of(out: Path, name: str, target: str) -> str:
    made, _ = snippets(bundle_of(out, name), target)
    return made[0].code


def export_all(folder: Path) -> Path:
    """All fixtures as bundles, one with labels, one with the trainer's own names."""
    for kind in KINDS:
        labels = {"actions": ["roll </script>", "pitch"]} if kind == "continuous" else None
        options = ExportOptions(folder, (*DEFAULTS, "csharp", "litert"), verify="none", labels=labels)
        list(export([fixture(kind)], options))
    renamed = folder / "own-names.bytes"
    shutil.copy(fixture("twobrains"), renamed)
    export_model(renamed, folder, to=(*DEFAULTS, "csharp", "litert"), names="source", verify="none")
    return folder
