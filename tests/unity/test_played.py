"""Emitted files that ML-Agents' players were given (../shared/unity/r3): what is written of the same sources now.

Every row of the record is asked: the model of that player plays the file of today, and its numbers are the policy's; or
it is refused by name, and only where a player threw, differed or was given nothing. The forms that players threw at are
read off the files themselves: onnx's own parser for ``.onnx``, and the layers of a ``.nn``.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import onnx
import pytest

from export_model.converters.consumers.profiles import profile
from export_model.converters.consumers.unity.checker import check_file
from export_model.converters.consumers.unity.consumers import CONSUMERS, EARLIER
from export_model.converters.consumers.unity.settings import Brain
from export_model.converters.formats.barracuda.format import NnModel, parse
from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.ops.barracuda.vocabulary import LayerType
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import ProfileError, SignatureError, UnsupportedOpError
from tests.barracuda.accepted import agent_of
from tests.barracuda.test_writer import assert_answers
from tests.exporting import export_model
from tests.known import ABSENT, SHARED
from tests.targets.dressed import Pair, Plain
from tests.targets.sweep import SENSORS

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


#: Runtime → the release that was played in it.
PLAYERS = {c.runtime: c for c in (*EARLIER.values(), *CONSUMERS.values())}
BATCHES = (1, 3, 16)


def cells() -> dict[str, dict[tuple[str, str], list[dict[str, Any]]]]:
    """Source → (profile, form) → its rows."""
    found: dict[str, dict[tuple[str, str], list[dict[str, Any]]]] = defaultdict(lambda: defaultdict(list))
    for row in rows():
        found[row["source"]][row["profile"], row["form"]].append(row)
    return found


CELLS = cells()


def was_right(row: dict[str, Any]) -> bool:
    """Whether a file was written, accepted, played without an exception, and equal where it was compared."""
    threw = isinstance(row.get("played"), list) or row.get("run", "ok") != "ok"
    return "refused_by_tool" not in row and not threw and False not in (row.get("accepted"), row.get("equal"))


@pytest.mark.parametrize("source", sorted(CELLS) or ["shared-is-absent"])
def test_what_was_played_is_played_or_refused_by_name(source: str, tmp_path: Path) -> None:
    if source not in CELLS:
        pytest.skip(ABSENT)
    path, brain = original(source), source.partition("#")[2]
    sensors = SENSORS.get(path.name, ())
    models = read_source(path, ReadOptions(sensors=sensors)).compile_models()
    plain = {policy.name: Plain(policy) for _, policy in models if policy.name.endswith(brain)}
    for (wanted, form), recorded in CELLS[source].items():
        folder = tmp_path / wanted / form
        try:
            made = export_model(path, folder, for_=wanted, to=form, sensors=sensors, verify="none")
        except (ProfileError, SignatureError, UnsupportedOpError) as error:
            assert error.fix, (wanted, form)
            assert not all(map(was_right, recorded)), (wanted, form, error.what)
            continue
        for result in (r for r in made if r.policy.name in plain):
            (file,) = result.folder.glob(f"*.{form}")
            agent = same_numbers(plain[result.policy.name], wanted, form, file)
            for row in (r for r in recorded if r.get("by") == "player"):
                verdict = check_file(file, PLAYERS[row["runtime"]], agent)
                assert verdict.refused is None, (wanted, form, verdict.refused)
                assert all(verdict.plays.values()), (wanted, form, verdict.played)
                assert verdict.checked.get("stochastic", True), (wanted, form, verdict.to_dict())


def same_numbers(plain: Plain, wanted: str, form: str, file: Path) -> Brain:
    """Fail where the numbers are not the policy's; the agent that it is for."""
    policy, consumer = plain.policy, profile(wanted)
    if form in consumer.own_names:
        assert_answers(policy, parse(file.read_bytes()), BATCHES)
        return agent_of(policy)
    pair = Pair.of(policy, consumer, plain, form=form)
    for seed, count in enumerate(BATCHES):
        assert pair.difference(count, seed) is None, (wanted, form, count)
    return pair.brain()


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
