"""What a wrong candidate's numbers are called: exchanged columns, units, a tanh, a clip, a scale; on both sides."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import onnx
import pytest

from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.compare import explaining
from export_model.exporter.compare.explaining import in_sides
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.logs import causes
from export_model.exporter.verify import report as report_module
from fixtures import path as fixture
from tests.compare.planted import ACTOR, LSTM, PAIRS, Edit, before_input, compared, is_named, other_weights
from tests.comparing import compare_artefacts
from tests.reports.validation import check_parity

CONTINUOUS = ACTOR.path


def planted(source: Path, target: Path, edit: Edit) -> Path:
    model = onnx.load(source)
    edit(model)
    onnx.save(model, target)
    return target


def sentences(reference: Path, candidate: Path, pool: RuntimePool) -> list[str]:
    report = compare_artefacts(reference, candidate, runtimes="onnxruntime", pool=pool)
    named = [note for note in report.notes if " is the reference with " in note or " is the candidate with " in note]
    assert bool(named) <= (report.passed is False), "only what differs is explained"
    return named


def test_sixty_wrong_pairs_are_planted() -> None:
    """``python -m tests.compare.planted`` counts them all; here are some."""
    assert len(PAIRS) == 60
    assert sum(bool(pair.words) for pair in PAIRS.values()) >= 50


@pytest.mark.parametrize("name", list(PAIRS)[::6])
def test_a_difference_is_called_what_it_is(name: str, tmp_path: Path, pool: RuntimePool) -> None:
    pair = PAIRS[name]
    report, named = compared(pair, tmp_path, pool)
    assert report.passed is False
    assert is_named(pair, named) == bool(pair.words), named


@pytest.mark.parametrize(("name", "kind"), [("actor: columns", "swap"), ("actor: tanh", "squash")])
def test_the_cause_is_data_too(name: str, kind: str, tmp_path: Path, pool: RuntimePool) -> None:
    report, named = compared(PAIRS[name], tmp_path, pool)
    content = report.to_dict()
    check_parity(json.dumps(content))
    (cause,) = content["causes"]
    assert (cause["kind"], cause["side"]) == (kind, "candidate")
    assert cause["format"] in {c["format"] for c in content["comparisons"]}
    assert any(cause["where"] in sentence and cause["says"] in sentence for sentence in named)
    same = compare_artefacts(ACTOR.path, ACTOR.path, runtimes="onnxruntime", pool=pool)
    assert "causes" not in same.to_dict()


def test_the_schema_has_every_kind_of_cause() -> None:
    schema = json.loads((Path(report_module.__file__).parents[1] / "reports/parity.schema.json").read_text())
    kinds = schema["properties"]["causes"]["items"]["properties"]["kind"]["enum"]
    assert sorted(explaining.CHANGES) == kinds


def test_no_sentence_speaks_of_a_log() -> None:
    """Every text of the table of causes that is said of a log and its policy is said of the two sides here."""
    code = re.sub(r'"""[^"]*"""', "", Path(causes.__file__).read_text())
    said = [s for s in re.findall(r'"([^"\n]*)"', code) if re.search(r"\blog\b|logged|the policy", s) and " " in s]
    assert len(said) > 20
    for sentence in said:
        assert not re.search(r"\blog\b|logged|policy\b", in_sides(sentence, "candidate", "reference")), sentence


@pytest.mark.parametrize("right", [False, True])
def test_an_image_upside_down_is_called_so(tmp_path: Path, pool: RuntimePool, right: bool) -> None:
    (result,) = export([fixture("visual")], ExportOptions(tmp_path, targets=("onnx",), verify="none"))
    own = result.folder / "visual.onnx"
    height = onnx.load(own).graph.input[1].type.tensor_type.shape.dim[1].dim_value
    wrong = planted(
        own, tmp_path / "wrong.onnx", before_input("Gather", np.arange(height)[::-1].copy(), place=1, axis=1)
    )
    named = sentences(own, own if right else wrong, pool)
    assert [("upside down" in sentence) for sentence in named] == ([] if right else [True])


def test_an_image_and_other_weights_have_no_name(tmp_path: Path, pool: RuntimePool) -> None:
    (result,) = export([fixture("visual")], ExportOptions(tmp_path, targets=("onnx",), verify="none"))
    own = result.folder / "visual.onnx"
    assert sentences(own, planted(own, tmp_path / "other.onnx", other_weights), pool) == []


def test_what_nothing_explains_has_no_name(tmp_path: Path, pool: RuntimePool) -> None:
    assert sentences(CONTINUOUS, planted(CONTINUOUS, tmp_path / "other.onnx", other_weights), pool) == []


def test_the_same_policy_is_not_explained(pool: RuntimePool) -> None:
    assert sentences(CONTINUOUS, CONTINUOUS, pool) == []


def lose_memory(model: onnx.ModelProto) -> None:
    """Take the memory that is given back out of the outputs, as BC of ML-Agents 0.3 did."""
    kept = [o for o in model.graph.output if o.name not in ("recurrent_out", "memory_size")]
    del model.graph.output[:]
    model.graph.output.extend(kept)


@pytest.mark.parametrize("wrong", [False, True])
def test_a_memory_that_is_not_given_back_is_fed(wrong: bool, tmp_path: Path, pool: RuntimePool) -> None:
    """A file beside itself failed: the search for a cause left it out, which counted as the candidate's failure."""
    own = planted(LSTM.path, tmp_path / "own.onnx", lose_memory)
    edit = before_input("Gather", np.array([0, 3, 2, 1, 4]), axis=1)
    named = sentences(own, planted(own, tmp_path / "other.onnx", edit) if wrong else own, pool)
    assert [("state[1], state[3] exchanged" in sentence) for sentence in named] == [True] * wrong
    if not wrong:
        assert compare_artefacts(own, own, runtimes="onnxruntime", pool=pool).passed


def test_a_search_ends(tmp_path: Path, pool: RuntimePool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no cause was enough it went on for minutes, of a policy with a memory; that it was cut short is said."""
    monkeypatch.setattr(explaining, "_MOST_RUNS", 40)
    own = LSTM.path
    other = planted(own, tmp_path / "other.onnx", before_input("Gather", np.array([0, 3, 2, 1, 4]), axis=1))
    report = compare_artefacts(own, other, runtimes="onnxruntime", pool=pool)
    assert report.passed is False
    assert any("was not searched to the end" in note for note in report.notes)
