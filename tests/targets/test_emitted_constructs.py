"""What our ONNX is made of, against what Unity's importers misread.

A construct that is read wrongly without an error by any importer fails here, unless ``ONLY_IN_1_1`` tells why it may
stand: over the fixtures, the lowering of every op, and every policy of ../shared.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import onnx
import pytest

from converters.format import WriteOptions
from converters.onnx.writer import write
from converters.targets.unity.constructs import Model, constructs
from converters.targets.unity.readings import IMPORTERS, MEASURED, Reading, misreadings
from exporter import export_model
from signatures.errors import ExportModelError, UnsupportedOpError
from tests.graph.harness import policy_of
from tests.graph.samples import SAMPLES, Sample

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared"

_PROFILE = "the plain ONNX is not for 1.1, which has no ArgMax; --for barracuda-1.0 writes another form"
#: Read wrongly by Barracuda 1.1.2 and rightly from 1.4 on: (op, what the table says) → why it may stand.
ONLY_IN_1_1 = {
    ("Sub", "a constant first operand: they are swapped"): f"another form costs a node more; {_PROFILE}",
    ("Div", "a constant first operand: they are swapped"): f"another form costs a node more; {_PROFILE}",
    ("Round", "halves are not rounded to even"): _PROFILE,
    ("Transpose", "of rank 3, batch above 1"): _PROFILE,
    ("Softmax", "of rank 3"): _PROFILE,
    ("LogSoftmax", "of rank 3"): _PROFILE,
    ("Reshape", "the elements come in another order"): _PROFILE,
    ("Slice", "two axes of rank 3"): _PROFILE,
    ("Slice", "an end beyond every index is misread"): "an axis of unknown length has no other end",
    ("Pad", "pads as an operand are not read"): _PROFILE,
}
FIRST = next(iter(IMPORTERS))


def wrong_readings(model: Model) -> Iterator[str]:
    for found in misreadings(model):
        if found.rule.reading is not Reading.WRONG:
            continue
        if found.importer != FIRST or (found.construct.op, found.rule.says) not in ONLY_IN_1_1:
            yield f"{found.importer}: {found.construct.name} = {found.construct.form()}: {found.rule.says}"


def unknown_operators(model: Model) -> set[str]:
    return {c.op for c in model} - MEASURED


def emitted(path: Path, folder: Path) -> Iterator[Any]:
    """The ONNX of each policy in a source; none where it is refused."""
    try:
        results = export_model(path, folder, to="onnx", verify="none")
    except ExportModelError:
        return
    for result in results:
        yield from (onnx.load(file) for file in sorted(result.folder.glob("*.onnx")))


# ------------------------------------------------------------------ ours


@pytest.mark.parametrize("path", sorted((ROOT / "fixtures").glob("*.bytes")), ids=lambda p: p.stem)
def test_no_construct_of_a_fixture_is_misread(path: Path, tmp_path: Path) -> None:
    models = [constructs(proto) for proto in emitted(path, tmp_path)]
    assert models
    assert [line for model in models for line in wrong_readings(model)] == []
    assert set().union(*map(unknown_operators, models)) == set()


#: Of single ops, not of policies: the shape of a tensor is no policy's output, and as an operand it is read rightly.
NO_POLICY = "Shape("


@pytest.mark.parametrize("sample", [s for s in SAMPLES if s.oracle is None], ids=lambda s: f"{s.op}-{s.title}")
def test_no_lowering_of_an_op_is_misread(sample: Sample) -> None:
    try:
        files = write(policy_of(sample.graph, sample.fetches), WriteOptions('{"tool": {"version": "test"}}'))
    except UnsupportedOpError as error:
        pytest.skip(f"not written as ONNX: {error}")
    model = constructs(onnx.ModelProto.FromString(next(iter(files.values())).joined()))
    assert [line for line in wrong_readings(model) if NO_POLICY not in line] == []


# ------------------------------------------------------------------ ../shared


def _sources() -> list[Path]:
    files = [p for room in ("corpus", "genuine", "foreign") for p in sorted((SHARED / room).rglob("*"))]
    return [p for p in files if p.suffix in (".bytes", ".pb", ".nn", ".onnx", ".pt", ".keras") and p.is_file()]


def _families() -> list[Any]:
    """A test for each folder of sources: policies of one case are alike."""
    folders: dict[Path, list[Path]] = {}
    for path in _sources():
        folders.setdefault(path.parent, []).append(path)
    return [pytest.param(v, id=str(k.relative_to(SHARED))) for k, v in folders.items()] or [
        pytest.param([], id="shared-is-absent")
    ]


@pytest.mark.corpus
@pytest.mark.parametrize("paths", _families())
def test_no_construct_of_a_known_policy_is_misread(paths: list[Path], tmp_path: Path) -> None:
    if not paths:
        pytest.skip("../shared (public models, genuine graphs) is not beside this checkout")
    found, unknown = [], set()
    for number, path in enumerate(paths):
        for proto in emitted(path, tmp_path / str(number)):
            model = constructs(proto)
            found += [f"{path.name}: {line}" for line in wrong_readings(model)]
            unknown |= unknown_operators(model)
    assert not found, "\n".join(found)
    assert not unknown
