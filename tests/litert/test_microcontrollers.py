"""LiteRT for Microcontrollers, held to what the interpreter of tflite-micro said of the same files (24 Nov 2026)."""

from __future__ import annotations

import pytest

from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.litert.microcontrollers import fit
from export_model.converters.formats.registry import WRITTEN
from export_model.exporter.export.sources import read_source
from export_model.exporter.inspect.inspection import inspect_source, inspection_text
from tests.commands import ROOT

FIXTURES = ROOT / "fixtures"
#: Source → what it refused (operators; none where it ran), and the arena's bytes where it came so far. tflite-micro
#: 0.dev20261023182759, 64 bits.
SAID: dict[str, tuple[tuple[str, ...], int | None]] = {
    "trained/3DBall": ((), 10736),
    "trained/Crawler2D": ((), 12912),
    "continuous.bytes": ((), 12272),
    "visual.bytes": ((), 32192),
    "discrete.bytes": (("ARG_MAX of int64",), 7088),
    "recurrent.bytes": (("GATHER of int32",), None),
    "trained/Hallway": (("ONE_HOT",), None),
    "sampled.bytes": (("MULTINOMIAL",), None),
}


@pytest.mark.parametrize("name", SAID)
def test_what_it_lacks_and_its_arena_are_what_the_interpreter_said(name: str) -> None:
    (policy,) = read_source(FIXTURES / name).policies()
    (file,) = WRITTEN["litert"].artifact(policy, WriteOptions("{}", batch=1)).files.values()
    found, (lacks, arena) = fit(file.to_bytes()), SAID[name]
    assert set(lacks) <= set(found.lacks)  # it stops at the first
    assert bool(lacks) == bool(found.lacks)
    if arena is not None:
        assert found.arena == pytest.approx(arena, rel=0.1)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("trained/3DBall", "LiteRT for Microcontrollers: an arena of about"),
        ("sampled.bytes", "LiteRT for Microcontrollers lacks: MULTINOMIAL"),
    ],
)
def test_inspect_says_so(name: str, said: str) -> None:
    inspection = inspect_source(FIXTURES / name)
    assert said in inspection_text(inspection)
    board = inspection.to_dict()["policies"][0]["board"]
    assert board["arena"] > 0 and bool(board["lacks"]) == ("lacks" in said)
