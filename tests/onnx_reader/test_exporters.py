"""Faults of other exporters: named from the file alone, mended by name, and nothing is said of right files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest

import export_model
from export_model.converters.formats.onnx.exporters import FAULTS, faulty_nodes
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


@pytest.mark.parametrize("name", [fault.name for fault in FAULTS])
def test_a_repaired_export_agrees_with_the_repaired_original_and_says_so(name: str, tmp_path: Path) -> None:
    file = FIXTURES / f"exporters/{name.replace('-', '_')}.onnx"
    read = export_model.ReadOptions(repair=name)
    (result,) = export_model.export(file, tmp_path, read=read, verify="onnxruntime")
    assert result.passed
    assert any(note.startswith(f"repaired, {name}: ") for note in result.policy.signature.notes)
    again = export_model.verify(result.folder, source=file, verify="onnxruntime")
    assert again.passed
    assert again.original == "onnxruntime"


@pytest.mark.parametrize(("name", "where"), [("pixel-unshuffle", "SpaceToDepth"), ("pool-divisor", "AveragePool")])
def test_what_the_exporter_notes_of_a_right_file_is_no_warning(name: str, where: str, tmp_path: Path) -> None:
    """One channel cannot be exchanged, and a divisor that is the window's size is none."""
    model = onnx.load(FIXTURES / f"exporters/{name.replace('-', '_')}.onnx")
    node = next(n for n in model.graph.node if n.op_type == where)
    call = next(p for p in node.metadata_props if p.key == "pkg.torch.onnx.fx_node")
    call.value = call.value.replace("True, 3)", "True, 4)")
    for value in model.graph.value_info:
        if value.name == node.input[0]:
            value.type.tensor_type.shape.dim[1].dim_value = 1
    assert not list(faulty_nodes(model))


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
