"""What our ONNX is made of, against what Unity's importers misread.

A construct that is read wrongly without an error by any importer fails here, unless ``ONLY_IN_1_1`` tells why it may
stand: over the fixtures, the lowering of every op, and every policy of ../shared.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import onnx
import pytest

from export_model.converters.consumers.unity.constructs import ConstructModel, constructs
from export_model.converters.consumers.unity.importers import IMPORTERS
from export_model.converters.consumers.unity.readings import MEASURED, Reading, misreadings
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.onnx.writer import write
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import UnsupportedOpError
from tests import known
from tests.graph.harness import policy_of
from tests.graph.samples import SAMPLES, Sample

ROOT = Path(__file__).resolve().parents[2]

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


def wrong_readings(model: ConstructModel) -> Iterator[str]:
    for found in misreadings(model):
        if found.rule.reading is not Reading.WRONG:
            continue
        if found.importer != FIRST or (found.construct.op, found.rule.says) not in ONLY_IN_1_1:
            forms = ", ".join(f"{o.source.value} {o.shape}" for o in found.construct.operands)
            yield f"{found.importer}: {found.construct.name} = {found.construct.op}({forms}): {found.rule.says}"


def unknown_operators(model: ConstructModel) -> set[str]:
    return {c.op for c in model} - MEASURED


def emitted(policies: Iterable[Policy]) -> Iterator[ConstructModel]:
    """What the ONNX of each policy is made of."""
    for policy in policies:
        (data,) = write(policy, WriteOptions('{"tool": {"version": "test"}}')).values()
        yield constructs(onnx.ModelProto.FromString(data.to_bytes()))


# ------------------------------------------------------------------ ours


@pytest.mark.parametrize("path", sorted((ROOT / "fixtures").glob("*.bytes")), ids=lambda p: p.stem)
def test_no_construct_of_a_fixture_is_misread(path: Path) -> None:
    models = list(emitted(read_source(path).policies()))
    assert models
    assert [line for model in models for line in wrong_readings(model)] == []
    assert set().union(*map(unknown_operators, models)) == set()


#: Of single ops, not of policies: the shape of a tensor is no policy's output, and as an operand it is read rightly.
NO_POLICY = "Shape("


@pytest.mark.parametrize("sample", [s for s in SAMPLES if s.oracle is None], ids=lambda s: f"{s.op}-{s.title}")
def test_no_lowering_of_an_op_is_misread(sample: Sample) -> None:
    try:
        (model,) = emitted([policy_of(sample.graph, sample.fetches)])
    except UnsupportedOpError as error:
        pytest.skip(f"not written as ONNX: {error}")
    assert [line for line in wrong_readings(model) if NO_POLICY not in line] == []


# ------------------------------------------------------------------ ../shared


@pytest.mark.corpus
@pytest.mark.parametrize("path", known.params(known.sources()))
def test_no_construct_of_a_known_policy_is_misread(path: Path) -> None:
    found, unknown = [], set()
    for model in emitted(known.policies_or_skip(path)):
        found += list(wrong_readings(model))
        unknown |= unknown_operators(model)
    assert not found, "\n".join(found)
    assert not unknown
