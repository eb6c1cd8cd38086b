"""Our model of ML-Agents' players does what they did: 87 small models in five runtimes (../shared/unity/r3/minimal).

What is right is told by rule: each model says what its action shows, and the recorder what it fed. Observations of
agent n are 0, 0.25, 0.5 … + 10 n, masks 1, 1, 0, 1, 1. So every recorded answer is right, wrong, an exception, or none.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.consumers.unity.checker import ModeVerdict, check_file
from export_model.converters.consumers.unity.consumers import CONSUMERS, EARLIER, consumer
from export_model.converters.consumers.unity.findings import Thrown
from export_model.converters.consumers.unity.players import PLAYERS, PlayOutcome
from export_model.converters.consumers.unity.settings import Brain, Sensor
from tests.unity.conftest import UNITY, lines

pytestmark = pytest.mark.corpus

ROWS = lines("r3/minimal/minimal.jsonl")
PARAMETERS = [pytest.param(row, id=row["id"]) for row in ROWS] or [pytest.param({}, id="shared-is-absent")]
RANK_2 = [
    pytest.param(row, id=f"{row['id']}-{row['runtime'].split(',')[0]}") for row in lines("r3/minimal/rank2.jsonl")
] or [pytest.param({}, id="shared-is-absent")]
#: Our name of a player → the column that holds it.
COLUMNS = {
    "R22": "Sentis 2.1.3 / ML-Agents 3.0.0",
    "R23": "Inference Engine 2.2.2 / the same code",
    "R20": "Barracuda 3.0.0 / ML-Agents 2.3.0-exp.3",
    "2.0.1": "Barracuda 2.0.0 / ML-Agents 2.0.1",
    "1.9.1": "Barracuda 1.3.2 / ML-Agents 1.9.1",
}
SUFFIXES = {"stochastic": "", "deterministic": "_deterministic"}
AGENTS = (1, 3)
STEPS = 3
MASKS = (1, 1, 0, 1, 1)
NO_ACTION = "no action came out"


@pytest.mark.parametrize("row", PARAMETERS)
def test_a_model_is_played_as_recorded(row: dict[str, Any], unity_data: Path) -> None:
    compared = [name for name, column in COLUMNS.items() if column in row["verdicts"]]
    assert compared
    for name in compared:
        recorded = row["verdicts"][COLUMNS[name]]
        verdict = check_file(UNITY / "r3" / "minimal" / row["file"], consumer(name), agent(row))
        if "process_killed" in recorded:
            assert {p.outcome for p in verdict.played} == {PlayOutcome.DIES}, name
            assert not any(verdict.accepted.values())
            continue
        assert (verdict.refused is None) is recorded["imported"], name
        if verdict.refused is not None:
            assert f"{verdict.refused.exception}: {verdict.refused.message}" == recorded["error"]
            continue
        for mode, judged in verdict.modes.items():
            assert listed(judged) == recorded_list(recorded, mode), (name, mode)
            assert fates(judged) == recorded_fates(row, recorded, mode), (name, mode, judged.played)


def agent(row: dict[str, Any]) -> Brain:
    """The recorder's agent."""
    names = {1: "VectorSensor", 2: "Sensor", 3: "Sensor"}
    sensors = [tuple(shape) for shape in row["agent"]["sensors"]]
    return Brain(
        row["agent"]["continuous"],
        tuple(row["agent"]["discrete"]),
        sum(shape[0] for shape in sensors if len(shape) == 1),
        1,
        tuple(Sensor("DataSensor", names[len(shape)], shape) for shape in sensors),
    )


# ------------------------------------------------------------------ ours, in the words of the record


def listed(judged: ModeVerdict) -> list[str]:
    """The Inspector's list, or the exception in its place."""
    if judged.check_throws is not None:
        return [plain(f"throws {said(judged.check_throws)}")]
    return [plain(f.message) for f in judged.checks]


def said(thrown: Thrown) -> str:
    return f"{thrown.exception}: {thrown.message}"


def plain(text: str) -> str:
    """In one line; what the stand-in of the engine's assert adds is not Unity's."""
    return " ".join(text.split()).replace("Value was False. Expected: True", "Value was False")


def fates(judged: ModeVerdict) -> set[str]:
    """What comes of it: ``right``, an outcome, or the exception's text."""
    failures = [p for p in judged.played if p.fails]
    found = {plain(p.exception) or p.outcome.value for p in failures[:1]}
    return found or {"right"}


# ------------------------------------------------------------------ the record


def recorded_list(recorded: dict[str, Any], mode: str) -> list[str]:
    entries = recorded["checker_deterministic_" + ("on" if mode == "deterministic" else "off")]
    texts = [e.removeprefix("Warning: ").removeprefix("Error: ") for e in entries if not e.startswith("at loading")]
    return [plain(text) for text in texts]


def recorded_fates(row: dict[str, Any], recorded: dict[str, Any], mode: str) -> set[str]:
    """The fate with three agents, or with one where three had none: what holds for some number of agents holds."""
    found = []
    for agents in AGENTS:
        key = f"played_{agents}_agent{'s' if agents > 1 else ''}"
        played = recorded[key + SUFFIXES[mode]]
        found.append(fate(row, recorded[key] if played == "the same" else played, agents))
    return {next((f for f in found if f != "right"), "right")}


def fate(row: dict[str, Any], played: Any, agents: int) -> str:
    if isinstance(played, dict):
        text = str(played["throws"])
        if text.startswith(NO_ACTION):
            return PlayOutcome.NOTHING.value
        return plain(text).replace(f"received ({agents}, ", "received (N, ")
    return "right" if is_right(row, played, agents) else PlayOutcome.WRONG.value


def is_right(row: dict[str, Any], played: list[dict[str, list[float]]], agents: int) -> bool:
    """Whether every agent got what the model was made to show, at every step."""
    for step, answers in enumerate(played):
        continuous = np.asarray(answers.get("continuous", ()), float).reshape(agents, -1)
        wanted = shown(row, agents, step)
        if wanted is not None and not np.allclose(continuous, np.asarray(wanted)[:, None], atol=1e-3):
            return False
        discrete = np.asarray(answers.get("discrete", ()), int).reshape(agents, -1)
        if discrete.size and not all(tuple(each) in allowed(row) for each in discrete):
            return False
    return len(played) == STEPS


def shown(row: dict[str, Any], agents: int, step: int) -> list[float] | None:
    """The continuous action of each agent: the mean of what the model was made to show; None for noise."""
    inputs = {name: shape for name, _, shape in row["inputs"]}
    if "epsilon" in inputs:
        return None
    if "recurrent_in" in inputs or "prev_action" in inputs:
        drawn = bool(row["agent"]["discrete"])  # (1, 1) at every step, so that the one before has the mean 1
        value = step if "recurrent_in" in inputs else min(step, 1) if drawn else 0
        return [float(value)] * agents
    for name, value in (("sequence_length", 1.0), ("batch_size", float(agents))):
        if name in inputs:
            return [value] * agents
    ((_, shape),) = [i for i in inputs.items() if i[0] in ("obs_0", "vector_observation")]
    sensors = row["agent"]["sensors"] if "vector_observation" in inputs else row["agent"]["sensors"][:1]
    return [float(np.mean(fed(sensors, int(np.prod(shape[1:])), n))) for n in range(agents)]


def fed(sensors: list[list[int]], width: int, agent: int) -> list[float]:
    """What an agent observes, cut or filled with zeros to what the model holds."""
    numbers = [0.25 * i + 10.0 * agent for shape in sensors for i in range(int(np.prod(shape)))]
    return [*numbers, *[0.0] * width][:width]


def allowed(row: dict[str, Any]) -> list[tuple[int, ...]]:
    """The discrete actions that are right: the highest that the mask allows, or any allowed one that Unity draws."""
    masks = MASKS if any(name == "action_masks" for name, _, _ in row["inputs"]) else (1,) * len(MASKS)
    open_ones = [[i for i in range(3) if masks[i]], [i for i in range(2) if masks[3 + i]]]
    if any(name == "action" for name, _, _ in row["outputs"]):
        return [(a, b) for a in open_ones[0] for b in open_ones[1]]
    return [(open_ones[0][-1], open_ones[1][-1])]


# ------------------------------------------------------------------ lists of entities, and whole files


@pytest.mark.parametrize("row", RANK_2)
def test_a_list_of_entities_is_read_as_recorded(row: dict[str, Any], unity_data: Path) -> None:
    """In Barracuda a model is right that gives what it would without its transposition, and none as it is written."""
    (name,) = (known for known, column in COLUMNS.items() if column.split(" / ")[0] == row["runtime"].split(",")[0])
    differences = row["worst_against_policy_without_transposition"], row["worst_against_onnx_as_written"]
    right = min(differences) < 1e-4
    verdict = check_file(UNITY / "r3" / "minimal" / f"{row['id']}.onnx", consumer(name))
    assert verdict.brain.sensors[0].shape == (3, 4)
    assert set(verdict.plays.values()) == {right}
    assert [p.outcome for p in verdict.played] == ([] if right else [PlayOutcome.WRONG])


def cases() -> Iterator[Any]:
    """(file, row) of every file that a player was given; numbers that our exporter got wrong are no player's doing."""
    for record in sorted((UNITY / "r3" / "cases").glob("*/*.json")):
        found = json.loads(record.read_text())
        if "verdicts" in found and record.parent.name != "sac_pt_tanh":
            for row in found["verdicts"]:
                if row["by"] == "player":
                    yield pytest.param(record.with_name(found["file"]), row, id=f"{found['file']}-{row['mlagents']}")


@pytest.mark.parametrize(("path", "row"), list(cases()) or [pytest.param(Path(), {}, id="shared-is-absent")])
def test_a_file_is_played_as_recorded(path: Path, row: dict[str, Any], unity_data: Path) -> None:
    (name,) = (c.name for c in (*CONSUMERS.values(), *EARLIER.values()) if c.runtime == row["runtime"])
    verdict = check_file(path, consumer(name))
    plays = row["played"] == "ok" and row.get("equal") is not False
    assert verdict.plays["stochastic"] is plays, verdict.played
    assert verdict.checked.get("stochastic", row["accepted"]) is row["accepted"]
    if row["played"] != "ok" and path.parent.name != "rank2_barracuda-3":
        assert plain(row["played"][0]["exception"]) in {plain(p.exception) for p in verdict.played}


# ------------------------------------------------------------------ the table


def test_every_row_names_models_that_were_played(unity_data: Path) -> None:
    played = {row["id"] for row in ROWS} | {row["id"] for row in lines("r3/minimal/rank2.jsonl")}
    played |= {f"r4/{Path(row['source']).stem}" for row in lines("r4/played.jsonl")}
    named = {e.strip() for row in rows() for part in row.evidence.split(";") for e in part.split(",") if e.strip()}
    assert {e for e in named if not e.startswith("cases/")} <= played
    assert all((UNITY / "r3" / e).is_dir() for e in named if e.startswith("cases/"))


def test_a_row_without_evidence_says_that_it_was_not_run() -> None:
    assert [row.form for row in rows() if not row.evidence and "not run" not in row.says] == []


def test_every_consumer_has_a_player() -> None:
    assert set(PLAYERS) == {*CONSUMERS, *EARLIER}


def rows() -> Iterator[Any]:
    for player in PLAYERS.values():
        yield from (*player.inputs, *player.outputs)


def test_all_models_are_there(unity_data: Path) -> None:
    assert len(ROWS) == 87
