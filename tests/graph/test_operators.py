"""docs/support-tables.md: each op × target is written as one, as several or refused by its name, and it says which."""

from __future__ import annotations

import pytest

from export_model.converters.graph.ops.base import written_as_older
from export_model.converters.graph.ops.table import SPELLINGS, TABLE
from tests import operators
from tests.graph.samples import SAMPLES
from tests.operators import ONE, OPS, REFUSED, SEVERAL, WRITERS, Outcome, cell, outcomes
from tests.support_tables import section

each_op = pytest.mark.parametrize("op", OPS)
LINES = section(operators.TITLE).splitlines()


def titled(op: str) -> list[str]:
    """The rows of the first table in which an op is named."""
    rows = [line for line in LINES[: LINES.index("### Approximated functions")] if line.startswith("| `")]
    return [row for row in rows if f"`{op}`" in row.split(" | ")[0]]


def cells_of(op: str) -> dict[str, str]:
    """An op's cells in the committed page, by the titles of the targets."""
    (row,) = titled(op)
    where = row.strip("| ").split(" | ")[1]
    said = dict(part.rsplit(" ", 1) for part in where.split(", ") if where != "one operator everywhere")
    cells = {title: said.pop(title, ONE) for title in WRITERS}
    assert not said
    return {title: cell if cell[0] in (ONE, SEVERAL, REFUSED) else ONE + cell for title, cell in cells.items()}


def test_every_op_has_a_row_or_is_written_as_those_that_have() -> None:
    """None is silently absent; a row for each op that has samples, which tests/graph/test_ops.py asks for."""
    assert {s.op for s in SAMPLES} == set(OPS)
    assert {*OPS, *operators.OLDER} == set(TABLE)
    (older,) = (line for line in LINES if line.startswith("Written as these first"))
    assert all((f"`{op}`" in older) == (TABLE[op].infer is written_as_older) for op in TABLE)
    assert all(len(titled(op)) == 1 for op in OPS)
    assert not any(titled(op) for op in SPELLINGS)


@each_op
def test_each_target_writes_an_op_or_refuses_it_by_its_name(op: str) -> None:
    """What an op is written as before a target is asked may be what is refused."""
    made = {op} | {n.op for sample, _ in operators.samples_of(op) for n in sample.nodes}
    for title in WRITERS:
        found = list(outcomes(op, title))
        assert sum(cell(found).startswith(state) for state in (ONE, SEVERAL, REFUSED)) == 1, title
        for outcome in found:
            if outcome.refused is not None:
                assert {name for _, name in outcome.refused} & (made if TABLE[op].older else {op}), title


def test_the_page_is_that_of_the_samples() -> None:
    assert section(operators.TITLE) == operators.page()


def test_each_row_of_the_saved_model_is_needed() -> None:
    """The op's samples have each of the other ops, and no op has a row whose SavedModel is the ``.bytes``."""
    for op, (less, more) in operators.IN_SAVED_MODEL.items():
        lost, gained = set[str](), set[str]()
        for sample, _ in operators.samples_of(op):
            mine, theirs = operators.tensorflow_ops(sample)
            lost |= (mine - theirs).keys()
            gained |= (theirs - mine).keys()
        assert (lost, gained) == (less, more), op


def test_an_op_that_a_saved_model_has_otherwise_needs_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operators, "IN_SAVED_MODEL", {})
    with pytest.raises(AssertionError, match="OneHot"):
        list(outcomes("OneHot", "TensorFlow"))


@pytest.mark.parametrize(
    ("op", "title", "expected"),
    [
        ("Erf", "LiteRT", SEVERAL),  # LiteRT's schema has no operator for it
        ("Sin", "`.nn`", REFUSED),  # version 16 has no such layer
        ("Split", "ONNX", f"{ONE}−"),  # parts of a length that is not known
        ("Rsqrt", "ONNX", SEVERAL),  # of Sqrt and Reciprocal
        ("Where", "TensorFlow.js", REFUSED),  # its model would have to be run asynchronously
        ("Softmax", "code", f"{ONE}+"),  # of one row of two numbers, else the largest, the sum and the shares
        ("LeakyRelu", "TensorFlow", SEVERAL),  # TensorFlow 1.4 lacks it
        ("_FusedMatMul", "TensorFlow", REFUSED),  # it came with TensorFlow 1.15
    ],
)
def test_cells_that_are_known(op: str, title: str, expected: str) -> None:
    assert cells_of(op)[title] == expected


def test_a_cell_says_one_of_three_and_marks_where_samples_differ() -> None:
    one, several = Outcome(["ADD"]), Outcome(["ADD", "MUL"])
    refused, upstream = Outcome(refused=(("op", "Add"),)), Outcome(["SHAPE", "ADD"], counts=False)
    assert cell([]) == ""
    assert [cell([o]) for o in (one, several, refused, upstream)] == [ONE, SEVERAL, REFUSED, SEVERAL]
    assert cell([one, several, refused]) == f"{ONE}+−"
    assert cell([several, refused]) == f"{SEVERAL}−"
    assert cell([one, upstream]) == ONE
    assert cell([Outcome(["CAST", "ADD", "RESHAPE"])]) == cell([Outcome(["CAST"])]) == ONE
    assert cell([Outcome(["Gather", "Gather"], results=2)]) == ONE
