"""Two files made by hand, compared with no process: the kernels take the part of TensorFlow."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.tolerances import Tolerance, ToleranceRule
from export_model.signatures.errors import UsageError
from tests.comparing import compare_artefacts
from tests.handmade import NodeDef, constant, continuous_policy, dense, graph_bytes, node, placeholder, sampled_policy
from tests.verify.judged import Model, Pool

F: dict[str, Any] = {"T": np.float32}


class Anew(Pool):
    """Each start draws otherwise."""

    def __init__(self) -> None:
        self.seeds = itertools.count()

    def process(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(load=lambda path, **options: Model(path, **{**options, "seed": next(self.seeds)}))


def write(folder: Path, nodes: Sequence[NodeDef], name: str = "theirs") -> Path:
    file = folder / f"{name}.bytes"
    file.write_bytes(graph_bytes(nodes))
    return file


def compared(
    folder: Path,
    ours: Sequence[NodeDef],
    *theirs: Sequence[NodeDef],
    names: Mapping[str, str] | None = None,
    **options: Any,
) -> ParityReport:
    files = [write(folder, nodes, f"theirs{i or ''}") for i, nodes in enumerate(theirs)]
    reference = write(folder, ours, "ours")
    return compare_artefacts(
        reference,
        files,
        names=names,
        runtimes="tensorflow",
        options=VerifyOptions(**options),
        pool=Anew(),  # type: ignore[arg-type]
    )


def changed(change: Callable[[str], list[NodeDef]], at: str = "end") -> list[NodeDef]:
    """The policy with something done to its action, or to what it observes."""
    if at == "end":
        return [placeholder("vector_observation"), *dense("mu", "vector_observation", 3, 2), *change("mu")]
    return [placeholder("vector_observation"), *change("vector_observation"), *dense("mu", "changed", 3, 2), _end()]


def _end(name: str = "action") -> NodeDef:
    return node(name, "Tanh", "mu", **F)


def _then(op: str, value: Any) -> Callable[[str], list[NodeDef]]:
    return lambda source: [
        node("tanh", "Tanh", source, **F),
        constant("by", value),
        node("action", op, "tanh", "by", **F),
    ]


def _before(op: str, value: Any) -> Callable[[str], list[NodeDef]]:
    return lambda source: [constant("by", value), node("changed", op, source, "by", **F)]


def _gather(source: str, order: list[int], name: str) -> list[NodeDef]:
    matrix = np.eye(len(order), dtype=np.float32)[:, order]
    return [constant("order", matrix), node(name, "MatMul", source, "order", transpose_a=False, transpose_b=False, **F)]


OURS = continuous_policy()


def test_a_file_agrees_with_itself_and_one_of_other_names(tmp_path: Path) -> None:
    report = compared(tmp_path, OURS, OURS)
    assert report.passed is True and report.original == "tensorflow" and not report.self_consistent
    assert {c.output for c in report.comparisons} == {"action"}
    assert report.notes == ("not compared, as bytes never had it: deterministic_action",)
    other = compared(tmp_path, OURS, continuous_policy("own/", "obs"))
    assert other.passed is True
    assert "bytes: state = own/obs, action = own/action, by their roles" in other.notes


@pytest.mark.parametrize(
    ("nodes", "words"),
    [
        (changed(_then("Mul", 0.25)), "scaled (the candidate's action is not"),
        (changed(_then("Add", 0.3)), "moved"),
        (changed(_then("Minimum", 0.1)), ""),
        (changed(lambda s: [node("action", "Identity", s, **F)]), "squashed otherwise"),
        (changed(lambda s: [node("t", "Tanh", s, **F), *_gather("t", [1, 0], "action")]), "exchanged"),
        (changed(_before("Mul", np.array([1, 1, -1], np.float32)), "start"), "state[2] scaled"),
        (changed(_before("Mul", np.float32(180 / np.pi)), "start"), "degrees"),
        (changed(lambda s: _gather(s, [2, 1, 0], "changed"), "start"), "exchanged"),
        (changed(lambda s: _gather(s, [1, 2, 0], "changed"), "start"), "in another order"),
    ],
)
def test_what_differs_is_called_what_it_is(nodes: list[NodeDef], words: str, tmp_path: Path) -> None:
    report = compared(tmp_path, OURS, nodes)
    assert report.passed is False and {f.output for f in report.failures} == {"action"}
    named = [n for n in report.notes if "is the reference with" in n or "is the candidate with" in n]
    assert bool(named) is bool(words) or not words
    assert not words or words in named[0], named


def recurrent(fed: bool = True) -> list[NodeDef]:
    return [
        placeholder("vector_observation", (None, 2)),
        placeholder("recurrent_in", (None, 2)),
        constant("growth", 0.5 if fed else 0.0),
        node("kept", "Mul", "recurrent_in", "growth", **F),
        node("recurrent_out", "Add", "kept", "vector_observation", **F),
        node("action", "Tanh", "recurrent_out", **F),
        constant("memory_size", 2),
    ]


def test_a_memory_that_is_not_fed_back_is_named(tmp_path: Path) -> None:
    assert compared(tmp_path, recurrent(), recurrent()).passed is True
    report = compared(tmp_path, recurrent(), recurrent(fed=False))
    assert report.passed is False and {"action", "recurrent_out"} <= {f.output for f in report.failures}
    assert any("used otherwise" in note for note in report.notes), report.notes


# ------------------------------------------------------------------ inputs and outputs


def valued(name: str = "value_estimate", sign: float = 1.0) -> list[NodeDef]:
    return [
        *OURS,
        *dense("v", "vector_observation", 3, 1),
        constant("sign", sign),
        node(name, "Mul", "v", "sign", **F),
    ]


def test_another_makers_file_may_leave_a_value_out(tmp_path: Path) -> None:
    """That both call an action "action" tells no maker; test_comparison.py drops an output of one maker's file."""
    report = compared(tmp_path, valued(), OURS)
    assert report.passed is True and "value_estimate" not in {c.output for c in report.comparisons}
    extra = compared(tmp_path, OURS, valued())
    assert extra.passed is True, "more than the reference has"


def test_outputs_are_mapped_as_a_user_says(tmp_path: Path) -> None:
    report = compared(tmp_path, valued(), valued("critic"), names={"value_estimate": "critic"})
    assert report.passed is True and {c.output for c in report.comparisons} == {"action", "value_estimate"}
    wrong = compared(tmp_path, valued(), valued("critic", -1.0), names={"value_estimate": "critic"})
    assert {f.output for f in wrong.failures} == {"value_estimate"}


@pytest.mark.parametrize("names", [{"nowhere": "action"}, {"action": "nowhere"}])
def test_a_name_that_is_none_is_refused(names: dict[str, str], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="nowhere"):
        compared(tmp_path, OURS, OURS, names=names)


def two_vectors(first: str = "vector_observation", second: str = "visual", turned: bool = False) -> list[NodeDef]:
    a, b = (second, first) if turned else (first, second)
    return [
        *(placeholder(first), placeholder(second)),
        *dense("left", a, 3, 2),
        *dense("right", b, 3, 2),
        constant("less", 0.3),
        node("rest", "Mul", "right", "less", **F),
        node("action", "Add", "left", "rest", **F),
    ]


def test_an_input_that_is_missing_or_too_many_blocks(tmp_path: Path) -> None:
    for pair in ((OURS, two_vectors()), (two_vectors(), OURS)):
        report = compared(tmp_path, *pair)
        assert report.passed is False
        assert all(f.kind == "failure" for f in report.failures), [f.reason for f in report.failures]
        assert any("input" in f.reason for f in report.failures)


@pytest.mark.parametrize("size", [2, 4])
def test_an_input_of_another_width_blocks(size: int, tmp_path: Path) -> None:
    nodes = [placeholder("vector_observation", (None, size)), *dense("mu", "vector_observation", size, 2), _end()]
    report = compared(tmp_path, OURS, nodes)
    assert report.passed is False and {f.kind for f in report.failures} == {"failure"}


@pytest.mark.parametrize("names", ["vector_observation", "obs"])
def test_an_action_of_another_width_is_a_fault(names: str, tmp_path: Path) -> None:
    report = compared(tmp_path, OURS, continuous_policy("" if names != "obs" else "own/", names, actions=3))
    (fault,) = report.failures
    assert (fault.output, fault.reason) == ("action", "shape [1, 3] instead of [1, 2]")
    assert not any("the same numbers" in note for note in report.notes)


def test_an_action_of_one_axis_is_the_same_numbers(tmp_path: Path) -> None:
    """[B] beside [B, 1]."""
    ours = continuous_policy(actions=1)
    flat = [*ours[:-1], node("tanh", "Tanh", "mu", **F), constant("rows", [-1])]
    flat.append(node("action", "Reshape", "tanh", "rows", T=np.float32, Tshape=np.int32))
    for pair in ((ours, flat), (flat, ours)):
        report = compared(tmp_path, *pair)
        assert report.passed is True, [f.reason for f in report.failures]


# ------------------------------------------------------------------ draws


def noisy(times: float = 1.0) -> list[NodeDef]:
    return [
        placeholder("vector_observation"),
        *dense("mean", "vector_observation", 3, 2),
        node("size", "Shape", "mean", T=np.float32, out_type=np.int32),
        node("random_normal/RandomStandardNormal", "RandomStandardNormal", "size", dtype=np.float32, T=np.int32),
        constant("spread", np.array([0.5, 0.2], np.float32) * np.float32(times)),
        node("scaled", "Mul", "random_normal/RandomStandardNormal", "spread", T=np.float32),
        node("action", "Add", "mean", "scaled", T=np.float32),
    ]


def test_what_is_drawn_is_compared(tmp_path: Path) -> None:
    report = compared(tmp_path, noisy(), noisy())
    assert report.passed is True, [(f.kind, f.output, f.reason) for f in report.failures]
    assert {f.output for f in compared(tmp_path, noisy(), noisy(1.1)).failures} == {"action"}
    assert compared(tmp_path, sampled_policy(), sampled_policy()).passed is True


# ------------------------------------------------------------------ several candidates, options


def test_each_candidate_has_a_name(tmp_path: Path) -> None:
    report = compared(tmp_path, OURS, OURS, changed(_then("Mul", 0.25)), OURS)
    assert report.passed is False
    assert {f.format for f in report.failures} == {f"bytes {tmp_path.name}/theirs1.bytes"}
    assert set(report.sizes) == {f"bytes {tmp_path.name}/theirs{i}.bytes" for i in ("", 1, 2)}
    file = write(tmp_path, OURS)
    twice = compare_artefacts(file, [file, file], runtimes="tensorflow", pool=Pool())  # type: ignore[arg-type]
    assert twice.passed is True and len(twice.sizes) == 2
    assert any(label.endswith(" (2)") for label in twice.sizes)
    (tmp_path / "a").mkdir()
    far = [write(tmp_path / "a", OURS), write(tmp_path, OURS)]
    other = compare_artefacts(file, far, runtimes="tensorflow", pool=Pool())  # type: ignore[arg-type]
    assert set(other.sizes) == {f"bytes {tmp_path.name}/theirs.bytes", "bytes a/theirs.bytes"}


def test_what_takes_no_part_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no candidate"):
        compare_artefacts(write(tmp_path, OURS), [], runtimes="tensorflow", pool=Pool())  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="--max-size"):
        compared(tmp_path, OURS, OURS, budget={"tfjs": 1})
    with pytest.raises(UsageError, match="--tolerances"):
        compared(tmp_path, OURS, OURS, rules=[ToleranceRule(Tolerance(), output="nothing")])
    assert compared(tmp_path, OURS, OURS, budget={"bytes": 1 << 20}).passed is True
    assert compared(tmp_path, OURS, OURS, budget={"bytes": 1}).passed is False
