"""How verification judges: runtimes that are played by the numpy kernels agree, and every fault is found and named."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from export_model.exporter.reports.summary import (
    failure_lines,
    parity_table,
)
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.tolerances import Tolerance
from export_model.exporter.verify.verdict import verdict
from fixtures import FIXTURES
from tests.exporter.rehearsal import (
    ActingPool,
    Exporting,
    Tensors,
    failures,
    report_of,
    spoiling,
)
from tests.handmade import constant, graph_bytes, node, placeholder

# ------------------------------------------------------------------ agreement


@pytest.mark.parametrize("name", [n for n in FIXTURES if n not in ("recurrent", "twobrains")])
def test_formats_that_agree_pass(name: str, exporting: Exporting) -> None:
    pool = ActingPool()
    result = exporting(name, pool)
    report = report_of(result)
    assert result.passed is True
    assert report.reference == "source/tensorflow"
    pairs = {(c.format, c.runtime) for c in report.comparisons}
    assert pairs == {
        *(("reference", "numpy"), ("bytes", "tensorflow"), ("onnx", "onnxruntime")),
        *(("saved_model", "tensorflow"), ("saved_model:deterministic", "tensorflow")),
        *(("tfjs", "tfjs-cpu"), ("tfjs", "tfjs-wasm")),
    }
    outputs = {s.name for s in result.policy.signature.outputs}
    assert {c.output for c in report.comparisons if c.format == "onnx"} == outputs
    assert {entry["status"] for entry in report.runtimes.values()} == {"ran"}
    assert len(pool.unloaded) == pool.loaded


def test_a_report_says_what_was_tried_and_how_it_went(exporting: Exporting) -> None:
    options = VerifyOptions(seed=5, samples=1, tolerance=Tolerance(1e-4, 1e-3))
    result = exporting("discrete", parity=options)
    written = json.loads((result.folder / "parity.json").read_text())
    assert written == report_of(result).to_dict()
    assert (written["schema"], written["policy"], written["passed"]) == (1, "discrete", True)
    assert (written["seed"], written["samples"]) == (5, 1)
    assert written["runtimes"]["onnxruntime"] == {"version": "1.0", "status": "ran", "reason": None}
    for entry in written["comparisons"]:
        assert {
            *("format", "runtime", "output", "max_abs_diff", "max_rel_diff", "atol", "rtol", "passed", "worst_input")
        } <= set(entry)
        assert (entry["atol"], entry["rtol"]) == (1e-4, 1e-3)
    assert written["sizes"] == dict(result.sizes)


def test_the_memory_is_fed_back(exporting: Exporting, tmp_path: Path) -> None:
    """``recurrent`` keeps its loop in the source, so its own .bytes is the source here: it is straight."""
    exporting("recurrent", ActingPool(refused=frozenset({("source", "tensorflow")})))
    straight = tmp_path / "recurrent.bytes"
    straight.write_bytes((tmp_path / "out" / "recurrent" / "recurrent.bytes").read_bytes())

    def forgets(answer: Tensors) -> None:
        if "recurrent_out" in answer:
            answer["recurrent_out"] = answer["recurrent_out"] * np.float32(1.001)

    good = exporting(straight, name="good", parity=VerifyOptions(steps=3))
    rollouts = [c for c in report_of(good).comparisons if c.kind == "rollout" and c.format == "onnx"]
    assert good.passed is True
    assert {c.output for c in rollouts} >= {"action", "recurrent_out"}
    assert all(len(c.drift) == 3 for c in rollouts)
    bad = exporting(straight, ActingPool(spoiling("onnx", "onnxruntime", forgets)), name="bad")
    found = [c for c in report_of(bad).failures if c.kind == "rollout"]
    assert ("onnx", "onnxruntime", "recurrent_out", "rollout") in failures(bad)
    assert all(len(c.drift) == 4 for c in found)
    assert all(str(c.worst_input).startswith("step ") for c in found)


# ------------------------------------------------------------------ faults


def _a_little(answer: Tensors) -> None:
    answer["action"] = answer["action"] + np.float32(3e-5)


def _one_row(answer: Tensors) -> None:
    answer["action"] = answer["action"].copy()
    answer["action"][-1] += np.float32(0.1)


def _nan(answer: Tensors) -> None:
    answer["action"] = np.full_like(answer["action"], np.nan)


def _infinite(answer: Tensors) -> None:
    answer["action"] = np.full_like(answer["action"], np.inf)


def _wide(answer: Tensors) -> None:
    answer["action"] = answer["action"].astype(np.float64)


def _flat(answer: Tensors) -> None:
    answer["action"] = answer["action"][:1]


def _without(answer: Tensors) -> None:
    answer.pop("action", None)


FAULTS = [
    (_a_little, "action differs by "),
    (_one_row, "action differs by 0.1"),
    (_nan, "NaN or infinity on one side only"),
    (_infinite, "NaN or infinity on one side only"),
    (_wide, "dtype float64 instead of float32"),
    (_flat, "shape [1, 2] instead of"),
    (_without, "gave no output 'action'"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("change", "words"), FAULTS, ids=[f[0].__name__.strip("_") for f in FAULTS])
@pytest.mark.parametrize(
    ("kind", "runtime"),
    [("bytes", "tensorflow"), ("saved_model", "tensorflow"), ("tfjs", "tfjs-wasm"), ("onnx", "onnxruntime")],
)
def test_a_fault_is_found_and_named(
    kind: str, runtime: str, change: Callable[[Tensors], object], words: str, exporting: Exporting
) -> None:
    result = exporting("continuous", ActingPool(spoiling(kind, runtime, change)))
    report = report_of(result)
    assert result.passed is False
    assert {(c.format.split(":")[0], c.runtime) for c in report.failures} == {(kind, runtime)}
    text = "\n".join(failure_lines(report))
    assert f"{kind} in {runtime}: " in text
    assert words in text
    disagree = [c for c in report.failures if c.kind != "failure"]
    silent = f"no answer from {kind} in {runtime}"
    assert verdict(report).startswith(f"FAILED: {len(disagree)} of " if disagree else f"FAILED: {silent}")
    assert not disagree or f"; {kind} alone differs, " in verdict(report).replace(f" in {runtime} alone", " alone")
    line = next(row for row in parity_table(report).splitlines() if f" {kind} " in row and runtime in row)
    assert line.startswith("FAIL ")


def test_a_difference_that_rounding_explains_is_no_fault(exporting: Exporting) -> None:
    """Inputs of 1e3 make numbers that no two runtimes compute alike."""

    def ulp(kind: str, runtime: str, answer: Tensors) -> Tensors:
        if kind == "onnx":
            answer["value_estimate"] = np.nextafter(answer["value_estimate"], np.float32(np.inf))
        return answer

    assert exporting("continuous", ActingPool(ulp), parity=VerifyOptions(tolerance=Tolerance(0, 0))).passed is not None
    assert exporting("continuous", ActingPool(ulp)).passed is True


def test_narrow_integers_are_allowed_in_tensorflow_js_only(exporting: Exporting) -> None:
    def narrow(answer: Tensors) -> None:
        answer["deterministic_action"] = answer["deterministic_action"].astype(np.int32)

    assert exporting("discrete", ActingPool(spoiling("tfjs", "tfjs-cpu", narrow))).passed is True
    failed = exporting("discrete", ActingPool(spoiling("onnx", "onnxruntime", narrow)))
    assert failures(failed) == {("onnx", "onnxruntime", "deterministic_action", "numbers")}


def test_another_choice_is_a_fault_unless_it_is_a_tie(exporting: Exporting, tmp_path: Path) -> None:
    def other(answer: Tensors) -> None:
        answer["deterministic_action"] = 1 - answer["deterministic_action"]

    def policy(step: float) -> Path:
        nodes = [
            placeholder("vector_observation"),
            *(constant(n, np.array(v, np.float32)) for n, v in (("k", np.zeros((3, 2))), ("b", [0.0, step]))),
            node("MatMul", "MatMul", "vector_observation", "k", transpose_a=False, transpose_b=False),
            node("logits", "BiasAdd", "MatMul", "b"),
            node("Softmax", "Softmax", "logits"),
            node("action", "Log", "Softmax"),
        ]
        path = tmp_path / f"step{step}.bytes"
        path.write_bytes(graph_bytes(nodes))
        return path

    pool = ActingPool(spoiling("onnx", "onnxruntime", other))
    assert exporting(policy(0.0), pool).passed is True
    assert exporting(policy(1e-6), pool).passed is True
    assert failures(exporting(policy(0.1), pool)) == {("onnx", "onnxruntime", "deterministic_action", "numbers")}


# ------------------------------------------------------------------ draws


@pytest.mark.slow
def test_draws_have_the_right_distribution(exporting: Exporting) -> None:
    report = report_of(exporting("sampled"))
    draws = [c for c in report.comparisons if c.kind == "draws"]
    assert {(c.format, c.runtime) for c in draws} == {
        *(("reference", "numpy"), ("bytes", "tensorflow"), ("saved_model", "tensorflow")),
        *(("tfjs", "tfjs-cpu"), ("tfjs", "tfjs-wasm"), ("onnx", "onnxruntime")),
    }
    assert all(c.passed and 0 <= c.max_abs_diff <= 1 for c in draws)
    assert "drawn: action" in parity_table(report)


def _always(choice: int) -> Callable[[Tensors], None]:
    def change(answer: Tensors) -> None:
        answer["action"] = np.full_like(answer["action"], choice)

    return change


@pytest.mark.slow
def test_a_sampler_that_always_draws_the_same_is_found(exporting: Exporting) -> None:
    result = exporting("sampled", ActingPool(spoiling("onnx", "onnxruntime", _always(0))))
    assert ("onnx", "onnxruntime", "action", "draws") in failures(result)
    assert "the same after every start" in "\n".join(failure_lines(report_of(result)))


@pytest.mark.slow
@pytest.mark.parametrize("choice", [-1, 7])
def test_a_class_outside_of_its_branch_is_found(choice: int, exporting: Exporting) -> None:
    result = exporting("sampled", ActingPool(spoiling("tfjs", "tfjs-cpu", _always(choice))))
    assert "a class outside of its branch was drawn" in "\n".join(failure_lines(report_of(result)))


@pytest.mark.slow
def test_a_draw_of_the_wrong_shape_is_found(exporting: Exporting) -> None:
    def transposed(answer: Tensors) -> None:
        answer["action"] = answer["action"].T

    result = exporting("sampled", ActingPool(spoiling("bytes", "tensorflow", transposed)))
    assert "shape [3, 1] instead of [1, 3]" in "\n".join(failure_lines(report_of(result)))


# ------------------------------------------------------------------ runtimes that fail


def test_a_runtime_that_refuses_a_model_is_a_failed_comparison(exporting: Exporting) -> None:
    result = exporting("continuous", ActingPool(refused=frozenset({("tfjs", "tfjs-cpu")})))
    assert failures(result) == {("tfjs", "tfjs-cpu", "*", "failure")}
    assert "tfjs in tfjs-cpu: tfjs-cpu failed: it does not like this model" in "\n".join(
        failure_lines(report_of(result))
    )


def test_a_source_that_its_runtime_refuses_decides_nothing(exporting: Exporting) -> None:
    result = exporting("continuous", ActingPool(refused=frozenset({("source", "tensorflow")})))
    assert failures(result) == {("source", "tensorflow", "*", "undecided")}
    assert report_of(result).passed is None
    assert report_of(result).reference == "numpy"


def test_a_runtime_that_dies_while_it_works_is_a_failed_comparison(exporting: Exporting) -> None:
    """The next model finds it started again, and the one it died with is not asked to be freed."""
    pool = ActingPool()

    def die(answer: Tensors) -> None:
        pool.processes["tensorflow"].alive = False
        pool.processes["tensorflow"].must_live()

    pool.spoil = spoiling("bytes", "tensorflow", die)
    result = exporting("continuous", pool)
    assert failures(result) == {("bytes", "tensorflow", "*", "failure")}
    assert ("saved_model", "tensorflow") in {(c.format, c.runtime) for c in report_of(result).comparisons if c.passed}


def test_a_runtime_that_dies_at_the_end_is_reported_as_one_that_ran(exporting: Exporting) -> None:
    pool = ActingPool()

    def die(answer: Tensors) -> None:
        pool.processes["onnxruntime"].alive = False
        pool.processes["onnxruntime"].must_live()

    pool.spoil = spoiling("onnx", "onnxruntime", die)
    report = report_of(exporting("continuous", pool))
    assert report.runtimes["onnxruntime"] == {"version": "1.0", "status": "ran", "reason": None}


def test_a_source_that_fails_while_it_runs_ends_the_comparison(exporting: Exporting) -> None:
    pool = ActingPool()

    def die(answer: Tensors) -> None:
        pool.processes["tensorflow"].alive = False
        pool.processes["tensorflow"].must_live()

    pool.spoil = spoiling("source", "tensorflow", die)
    result = exporting("continuous", pool)
    assert failures(result) == {("source", "tensorflow", "*", "undecided")}
    assert report_of(result).passed is None
    assert len(report_of(result).comparisons) == 1


# ------------------------------------------------------------------ where it goes


def test_a_bundle_that_does_not_agree_is_kept_apart(exporting: Exporting, tmp_path: Path) -> None:
    good = exporting("continuous")
    before = {p.name: p.read_bytes() for p in good.folder.iterdir() if p.is_file()}
    bad = exporting("continuous", ActingPool(spoiling("onnx", "onnxruntime", _one_row)))
    assert bad.folder == tmp_path / "out" / "continuous.failed"
    assert json.loads((bad.folder / "parity.json").read_text())["passed"] is False
    assert {p.name: p.read_bytes() for p in good.folder.iterdir() if p.is_file()} == before
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"continuous", "continuous.failed"}
    again = exporting("continuous", ActingPool(spoiling("onnx", "onnxruntime", _nan)))
    assert again.folder == bad.folder
    assert "NaN" in (bad.folder / "parity.json").read_text()
