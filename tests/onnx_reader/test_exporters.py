"""Faults of other exporters: named from the file alone, mended by name, and nothing is said of right files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest

import export_model
from export_model.converters.formats.onnx.exporters import FAULTS
from export_model.converters.formats.source import ReadOptions
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import UsageError
from tests.comparing import compare_artefacts

FIXTURES = Path(__file__).resolve().parents[2] / "fixtures"
GRU = FIXTURES / "exporters/gru_reset.onnx"


def notes_of(path: Path, repair: str | None = None) -> tuple[str, ...]:
    (policy,) = read_source(path, ReadOptions(repair=repair)).policies()
    return policy.signature.notes


@pytest.mark.parametrize("repaired", [False, True])
@pytest.mark.parametrize("name", [fault.name for fault in FAULTS])
def test_a_repaired_file_acts_as_pytorch_does_over_20_steps(name: str, repaired: bool) -> None:
    file = FIXTURES / f"exporters/{name.replace('-', '_')}.onnx"
    policy = export_model.load(file, read=export_model.ReadOptions(repair=name if repaired else None))
    agent = policy.agent(deterministic=True)
    with np.load(file.with_suffix(".npz")) as known:
        actions = np.stack([agent.decide({"state": row}).action for row in known["obs"]])
        off = np.abs(actions - known["actions"]).max()
        allowed = 1e-6 * max(1, np.abs(known["actions"]).max())
    assert off <= allowed if repaired else off > 0.01


def test_the_fault_is_named_with_its_evidence_and_the_repair_with_the_policy() -> None:
    (named,) = (note for note in notes_of(GRU) if "exporter" in note)
    assert all(words in named for words in ("pytorch#189225", "--repair gru-reset", "node_gru"))
    (mended,) = (note for note in notes_of(GRU, "gru-reset") if "pytorch#189225" in note)
    assert mended.startswith("repaired, gru-reset: ")


def test_a_repaired_export_agrees_with_the_repaired_original_and_says_so(tmp_path: Path) -> None:
    read = export_model.ReadOptions(repair="gru-reset")
    (result,) = export_model.export(GRU, tmp_path, read=read, verify="onnxruntime")
    assert result.passed
    again = export_model.verify(result.folder, source=GRU, verify="onnxruntime")
    assert again.passed


def test_the_wrong_file_and_the_repaired_one_differ(tmp_path: Path, pool: RuntimePool) -> None:
    right = onnx.load(GRU)
    next(
        a for n in right.graph.node if n.op_type == "GRU" for a in n.attribute if a.name == "linear_before_reset"
    ).i = 1
    onnx.save(right, tmp_path / "right.onnx")
    report = compare_artefacts(tmp_path / "right.onnx", GRU, runtimes="onnxruntime", pool=pool)
    assert report.passed is False
    assert any("fault of the exporter" in note for note in report.notes)


def test_a_repair_that_a_file_does_not_need_is_refused() -> None:
    for name in (*(fault.name for fault in FAULTS), "unknown"):
        with pytest.raises(UsageError) as caught:
            read_source(FIXTURES / "sb3/torch_actor.onnx", ReadOptions(repair=name))
        assert "none of the faults" in str(caught.value.why)


@pytest.mark.corpus
def test_no_right_file_is_warned_of() -> None:
    shared = FIXTURES.parents[1] / "shared"
    if not shared.is_dir():
        pytest.skip("../shared is not here")
    files = [f for place in ("foreign", "corpus/onnx", "unity/r4") for f in sorted((shared / place).glob("*.onnx"))]
    for file in files:
        (source,) = read_source(file).models
        assert not any("fault of the exporter" in note for note in source.facts.notes), file
