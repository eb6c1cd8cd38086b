"""Emitted files that ML-Agents' players threw at, or played otherwise (../shared/unity/r3): none has that form now.

The forms are read off the files themselves: onnx's own parser for ``.onnx``, and the layers of a ``.nn``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import onnx
import pytest

from converters.formats.barracuda.format import NnModel, parse
from converters.formats.barracuda.vocabulary import LayerType
from exporter import export_model
from tests.known import ABSENT, SHARED

pytestmark = [pytest.mark.corpus, pytest.mark.slow]

R3 = SHARED / "unity" / "r3"


def rows() -> Iterator[dict[str, Any]]:
    path = R3 / "played.jsonl"
    if path.is_file():
        yield from map(json.loads, path.read_text().splitlines())


def original(source: str) -> Path:
    """The file of a row's ``source``: ``genuine/CASE#BRAIN`` or ``foreign/NAME-ENDING``."""
    room, _, name = source.partition("#")[0].partition("/")
    if room == "genuine":
        folder = SHARED / room / name
        return next(p for end in ("frozen_graph_def.pb", "*.bytes") for p in sorted(folder.glob(end)))
    stem, _, ending = name.rpartition("-")
    return SHARED / room / f"{stem}.{ending}"


def throwing(profile: str, form: str) -> list[Any]:
    """The sources of which a player threw at the file of a profile."""
    found = {
        r["source"].partition("#")[0]
        for r in rows()
        if (r["profile"], r["form"]) == (profile, form)
        and (isinstance(r.get("played"), list) or r.get("equal") is False)
    }
    return [pytest.param(original(s), id=s) for s in sorted(found)] or [pytest.param(None, id="shared-is-absent")]


def emitted(source: Path | None, profile: str, form: str, folder: Path) -> list[Path]:
    if source is None:
        pytest.skip(ABSENT)
    made = export_model(source, folder, for_=profile, to=form, verify="none")
    return [path for result in made for path in result.folder.glob(f"*.{form}")]


@pytest.mark.parametrize("source", throwing("unity6", "onnx"))
def test_unity6_has_no_input_that_its_players_write_as_integers(source: Path | None, tmp_path: Path) -> None:
    for path in emitted(source, "unity6", "onnx", tmp_path):
        names = {i.name for i in onnx.load(path).graph.input}
        assert not names & {"prev_action", "sequence_length", "batch_size"}


@pytest.mark.parametrize("source", throwing("barracuda-1.0", "onnx"))
def test_a_gray_camera_goes_straight_into_its_convolution(source: Path | None, tmp_path: Path) -> None:
    for path in emitted(source, "barracuda-1.0", "onnx", tmp_path):
        graph = onnx.load(path).graph
        cameras = {i.name for i in graph.input if len(i.type.tensor_type.shape.dim) == 4}
        assert cameras
        assert {n.op_type for n in graph.node if cameras.intersection(n.input)} == {"Conv"}


def flattened_memories(model: NnModel) -> list[str]:
    """Layers that Barracuda 1.4.0 and 2.0.0 do nothing in: a Flatten, or a Reshape, of an input along W."""
    along_w = {i.name for i in model.inputs if len(i.shape) == 4 and i.shape[1] == 1 == i.shape[3]}
    return [
        layer.name
        for layer in model.layers
        if layer.type in (LayerType.FLATTEN, LayerType.RESHAPE) and along_w.intersection(layer.inputs)
    ]


@pytest.mark.parametrize("source", throwing("barracuda-1.4", "nn"))
def test_a_memory_of_a_nn_is_turned_and_not_flattened(source: Path | None, tmp_path: Path) -> None:
    for path in emitted(source, "barracuda-1.4", "nn", tmp_path):
        assert not flattened_memories(parse(path.read_bytes()))
