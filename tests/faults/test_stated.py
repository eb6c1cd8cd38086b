"""What a file states of its numbers beside the contract, and what its original cannot answer, planted otherwise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from export_model.converters.runtimes.pool import RuntimePool
from tests.faults.families import members
from tests.faults.judging import WAYS, Subject

pytestmark = [pytest.mark.xdist_group("runtimes"), pytest.mark.runtimes]


@pytest.mark.parametrize("way", WAYS)
def test_metadata_that_is_not_the_contracts_is_caught(way: str, tmp_path: Path, processes: RuntimePool) -> None:
    pytest.importorskip("onnxruntime")
    member = next(m for m in members() if m.name == "mjlab")
    subject = Subject(member, tmp_path, processes)
    assert subject.judge(None, way).verdict == "passed"
    edited = [f for f in subject.faults() if f.edit is not None]
    assert len(edited) == 3
    found = [subject.judge(fault, way) for fault in edited]
    assert [o.verdict for o in found] == ["caught"] * 3, [str(o) for o in found]


def test_a_frozen_graph_is_not_its_own_reference(tmp_path: Path, processes: RuntimePool) -> None:
    """Of a .nn and a Keras model no runtime answers: a .bytes that was written wrongly agreed with itself."""
    pytest.importorskip("tensorflow")
    for name in ("continuous.nn", "layers model"):
        member = replace(next(m for m in members() if m.name == name), form="bytes")
        folder = tmp_path / name
        folder.mkdir()
        subject = Subject(member, folder, processes)
        assert subject.judge(None, "export").verdict == "passed"
        wanted = [f for f in subject.faults() if f.kind in ("× 0.3", "noise none")]
        assert wanted
        found = [subject.judge(fault, "export") for fault in wanted]
        assert [o.verdict for o in found] == ["caught"] * len(wanted), [str(o) for o in found]
