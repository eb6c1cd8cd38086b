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
from signatures.errors import ProfileError, UnsupportedOpError
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


def flattened(model: NnModel) -> list[str]:
    """Flatten layers whose readers do not flatten by themselves: Barracuda up to 2.0.0 does nothing in them."""
    readers: dict[str, set[int]] = {}
    for layer in model.layers:
        for name in layer.inputs:
            readers.setdefault(name, set()).add(layer.type)
    own = {LayerType.DENSE, LayerType.RESHAPE}
    return [x.name for x in model.layers if x.type == LayerType.FLATTEN and not readers.get(x.name, set()) <= own]


@pytest.mark.parametrize("profile", ["barracuda-1.0", "barracuda-1.4"])
@pytest.mark.parametrize("source", throwing("barracuda-1.4", "nn") + throwing("barracuda-1.0", "nn"))
def test_nothing_in_a_nn_hangs_on_a_flatten(source: Path | None, profile: str, tmp_path: Path) -> None:
    try:
        files = emitted(source, profile, "nn", tmp_path)
    except (ProfileError, UnsupportedOpError) as error:
        assert error.fix  # refused by name: tests/barracuda/accepted.py says which and why
        return
    for path in files:
        model = parse(path.read_bytes())
        assert not flattened(model)
        kept = {m.input for m in model.memories}
        assert not [x.name for x in model.layers if x.type == LayerType.RESHAPE and kept.intersection(x.inputs)]
