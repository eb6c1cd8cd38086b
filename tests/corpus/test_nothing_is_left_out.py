"""Every public file of ../shared/corpus is exported and verified by one test."""

from __future__ import annotations

from pathlib import Path

import pytest

from export_model.exporter.export.sources import read_source
from tests.barracuda.conftest import public_files
from tests.corpus.conftest import SHARED, frozen_corpus

pytestmark = pytest.mark.corpus

CORPUS = SHARED / "corpus"


def covered() -> dict[str, set[Path]]:
    """Who exports and verifies what: the test's module → its files."""
    return {
        "tests/corpus/test_every_frozen_graph.py": set(frozen_corpus()),
        "tests/barracuda/test_export.py": set(public_files()),
        "tests/onnx_reader/test_every_onnx_model.py": set(CORPUS.glob("onnx/*.onnx")),
        # a run's folder counts as a whole: its checkpoint is exported, what lies beside it is compared with it
        "tests/checkpoint/test_genuine.py": {p for i in CORPUS.glob("ckpt/*/*.index") for p in i.parent.iterdir()},
    }


def test_every_file_is_in_exactly_one_set() -> None:
    files = {p for p in CORPUS.rglob("*") if p.is_file() and p.name != "manifest.jsonl"}
    owners = {p: [owner for owner, held in covered().items() if p in held] for p in files}
    assert {p.relative_to(CORPUS).as_posix(): who for p, who in owners.items() if len(who) != 1} == {}
    assert len(files) > 120


@pytest.mark.parametrize("owner", covered())
def test_the_sets_hold_policies(owner: str) -> None:
    """A file in a set that no reader takes would make its test fail, but only where all runtimes are installed."""
    if owner == "tests/checkpoint/test_genuine.py":
        return
    for path in sorted(covered()[owner]):
        assert read_source(path).models, path
