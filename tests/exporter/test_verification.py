"""How verification judges: runtimes that are played by the numpy kernels agree, and every fault is found and named."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from converters.graph.options import CompileOptions
from converters.graph.run import run_graph
from exporter.export.pipeline import ExportResult
from exporter.reports.summary import (
    comparison_table,
    failure_lines,
    not_run_line,
    parity_table,
    to_verify,
    verdict,
    whole_summary,
)
from exporter.verify.checks.numbers import plausible
from exporter.verify.findings import Failure, Finding, Numbers
from exporter.verify.options import VerifyOptions
from exporter.verify.original import Original
from exporter.verify.report import ParityReport
from exporter.verify.tolerances import Tolerance
from fixtures import FIXTURES
from fixtures import path as fixture
from signatures.errors import SignatureError, UnsupportedOpError
from signatures.roles import Role
from signatures.sampling import Case
from signatures.spec import PolicySignature, SourceMap, TensorSpec
from tests.exporter.rehearsal import ActingPool, Array, Spoil, Tensors, export, honest
from tests.handmade import NodeDef, constant, continuous_policy, dense, graph_bytes, node, placeholder

Exporting = Callable[..., ExportResult]


@pytest.fixture
def exporting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Exporting:
    """Export one policy with played runtimes."""

    def run(what: str | Path, pool: ActingPool | None = None, **options: object) -> ExportResult:
        source = what if isinstance(what, Path) else fixture(what)
        return export(monkeypatch, source, tmp_path / "out", pool or ActingPool(), **options)[0]

    return run


def report_of(result: ExportResult) -> ParityReport:
    assert result.report is not None
    return result.report


def spoiling(kind: str, runtime: str, change: Callable[[Tensors], object]) -> Spoil:
    """One format in one runtime answers something else where it is asked for the action."""

    def spoil(a: str, b: str, answer: Tensors) -> Tensors:
        if (a, b) == (kind, runtime) and {"action", "action:0"} & set(answer):
            change(answer)
        return answer

    return spoil


def failures(result: ExportResult) -> set[tuple[str, str, str, str]]:
    return {(c.format, c.runtime, c.output, c.kind) for c in report_of(result).failures}


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
    # The references, every pair but the reference itself, and the SavedModel's graph, whose constants were looked at;
    # what draws is started twice more.
    draws = {(c.format, c.runtime) for c in report.comparisons if c.kind == "draws" and c.runtime != "numpy"}
    assert len(pool.unloaded) == 2 + len(pairs) - 1 + 1 + 2 * len(draws)


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
    straight.write_bytes((tmp_path / "out" / "recurrent.failed" / "recurrent.bytes").read_bytes())

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
    assert verdict(report).startswith(f"FAILED: {len(report.failures)} of {len(report.comparisons)}")
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


def test_a_source_that_its_runtime_refuses_is_a_failed_comparison(exporting: Exporting) -> None:
    result = exporting("continuous", ActingPool(refused=frozenset({("source", "tensorflow")})))
    assert failures(result) == {("source", "tensorflow", "*", "failure")}
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
    assert failures(result) == {("source", "tensorflow", "*", "failure")}
    assert len(report_of(result).comparisons) == 1


# ------------------------------------------------------------------ what is compared


def test_without_bytes_a_reference_is_made_for_the_comparison(exporting: Exporting) -> None:
    result = exporting("continuous", targets=("onnx",))
    assert result.passed is True
    assert {c.format for c in report_of(result).comparisons} == {"reference", "onnx"}
    assert not list(result.folder.glob("*.bytes"))


@pytest.mark.slow
def test_noise_that_stays_in_the_graph_is_compared_by_its_shape_and_distribution(exporting: Exporting) -> None:
    report = report_of(exporting("visual", compile=CompileOptions(noise="keep")))
    kinds = {(c.output, c.kind) for c in report.comparisons if c.format == "onnx"}
    numbers = {("deterministic_action", "numbers"), ("value_estimate", "numbers")}
    assert kinds == {("action", "shape"), ("action", "draws"), *numbers}


@pytest.mark.slow
@pytest.mark.parametrize("spoilt", [np.nan, 3.0])
def test_noise_that_stays_in_the_graph_and_goes_wrong_is_found(exporting: Exporting, spoilt: float) -> None:
    def wrong(answer: Tensors) -> None:
        answer["action"] = answer["action"] * np.float32(spoilt)

    pool = ActingPool(spoiling("onnx", "onnxruntime", wrong))
    report = report_of(exporting("visual", pool, compile=CompileOptions(noise="keep")))
    assert {(c.output, c.runtime) for c in report.failures} == {("action", "onnxruntime")}


def test_a_parameter_that_is_longer_than_the_batch_does_not_change_it(exporting: Exporting, tmp_path: Path) -> None:
    """The rows of a case are those of the observation."""
    nodes = [
        *(placeholder("vector_observation"), placeholder("table", (9, 2))),
        constant("axis", 0),
        node("best", "Max", "table", "axis", keep_dims=False),
        *dense("mu", "vector_observation", 3, 2),
        node("shape", "Shape", "mu", out_type=np.int32),
        node("noise", "RandomStandardNormal", "shape", dtype=np.float32, seed=1, seed2=2),
        node("sum", "Add", "mu", "noise"),
        node("action", "Add", "sum", "best"),
    ]
    (tmp_path / "table.bytes").write_bytes(graph_bytes(nodes))
    result = exporting(tmp_path / "table.bytes")
    assert [s.shape for s in result.policy.signature.inputs] == [(None, 3), (None, 2), (9, 2)]
    assert result.passed is True


@pytest.mark.parametrize(
    ("layout", "turns"),
    [((2, None), (1, 0)), ((1, None, 2), ()), ((2, 1, None), (2, 1, 0))],
    ids=["[n, B]", "[1, B, n]", "[n, 1, B]"],
)
def test_noise_whose_rows_are_not_its_first_axis(
    layout: tuple[int | None, ...], turns: tuple[int, ...], exporting: Exporting, tmp_path: Path
) -> None:
    """TensorFlow Probability draws so. It is one row of the input for each agent, and its deviation may overflow."""
    nodes = [
        placeholder("vector_observation"),
        *dense("mu", "vector_observation", 3, 2),
        *dense("log_sigma", "vector_observation", 3, 2),
        node("sigma", "Exp", "log_sigma"),
        node("all", "Shape", "mu", out_type=np.int32),
        *(constant("zero", [0]), constant("one", [1]), constant("axis", 0)),
        node("rows", "StridedSlice", "all", "zero", "one", "one", Index=np.int32),
        # a quotient of lengths, as TFP computes how many are drawn
        node("times", "FloorDiv", "rows", "rows"),
        *(constant(f"d{i}", [d or 0]) for i, d in enumerate(layout)),
        *(node(f"e{i}", "Mul", f"d{i}", "times") for i in range(len(layout))),
        node(
            "shape",
            "ConcatV2",
            *("rows" if d is None else f"e{i}" for i, d in enumerate(layout)),
            "axis",
            N=len(layout),
        ),
        node("noise", "RandomStandardNormal", "shape", dtype=np.float32, seed=1, seed2=2),
        *((constant("order", turns), node("turned", "Transpose", "noise", "order")) if turns else ()),
        node("flat", "Reshape", "turned" if turns else "noise", "all"),
        node("spread", "Mul", "sigma", "flat"),
        node("action", "Add", "mu", "spread"),
    ]
    (tmp_path / "turned.bytes").write_bytes(graph_bytes(nodes))
    result = exporting(tmp_path / "turned.bytes")
    assert result.policy.signature.input("epsilon").shape == (None, 2)
    assert result.passed is True
    feeds = {"state": np.zeros((3, 3), np.float32), "epsilon": np.zeros((3, 2), np.float32)}
    still = run_graph(result.policy.graph, feeds, ["action"])["action"]
    feeds["epsilon"][1] = 1  # an agent's noise is its own
    assert (run_graph(result.policy.graph, feeds, ["action"])["action"] != still).any(axis=1).tolist() == [
        False,
        True,
        False,
    ]


def test_noise_of_which_nobody_knows_how_much_an_agent_has_is_refused(exporting: Exporting, tmp_path: Path) -> None:
    nodes = [
        placeholder("vector_observation"),
        *dense("mu", "vector_observation", 3, 2),
        *(node("all", "Shape", "mu", out_type=np.int32), constant("axis", [0])),
        node("count", "Prod", "all", "axis", keep_dims=True),
        node("noise", "RandomStandardNormal", "count", dtype=np.float32),
        node("rows", "Reshape", "noise", "all"),
        node("action", "Add", "mu", "rows"),
    ]
    (tmp_path / "flat.bytes").write_bytes(graph_bytes(nodes))
    with pytest.raises(UnsupportedOpError, match="how many numbers 'noise'"):
        exporting(tmp_path / "flat.bytes")
    named = CompileOptions(outputs={"mu": Role.ACTION})
    assert exporting(tmp_path / "flat.bytes", compile=named).passed is True


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


# ------------------------------------------------------------------ reports


def comparison(kind: type[Finding] = Numbers, **fields: object) -> Finding:
    values: dict[str, object] = {
        "format": "onnx",
        "runtime": "onnxruntime",
        "output": "action",
        "max_abs_diff": 0.5,
        "max_rel_diff": 0.25,
        "tolerance": Tolerance(),
        "passed": False,
        "worst_input": "zeros",
        **fields,
    }
    return kind(**values)  # type: ignore[arg-type]


def test_numbers_that_json_lacks_are_strings() -> None:
    entry = comparison(max_abs_diff=float("inf"), max_rel_diff=float("nan"), drift=(0.0, float("-inf"))).to_dict()
    assert (entry["max_abs_diff"], entry["max_rel_diff"], entry["drift"]) == ("inf", "nan", [0.0, "-inf"])
    assert json.loads(json.dumps(entry, allow_nan=False)) == entry


def test_what_is_out_of_the_ordinary_is_in_the_entry() -> None:
    plain = comparison().to_dict()
    assert not {"tolerance_reason", "rounding", "reason", "drift"} & set(plain)
    entry = comparison(tolerance=Tolerance(1, 1, "it cancels"), rounding=0.1, reason="odd").to_dict()
    assert (entry["tolerance_reason"], entry["rounding"], entry["reason"]) == ("it cancels", 0.1, "odd")


def test_a_failure_says_by_how_much_and_what_would_be_allowed() -> None:
    report = ParityReport("p", False, 0, 2, "numpy", {}, (comparison(), comparison(kind=Failure, reason="died")))
    first, second = failure_lines(report)
    assert first.strip() == (
        "onnx in onnxruntime: action differs by 0.5 (relative 0.25), allowed 1e-05 + 1e-05·|reference| [numbers, zeros]"
    )
    assert second.strip() == "onnx in onnxruntime: died"
    assert "5.0e-01 action" in parity_table(report)


def test_a_report_without_an_independent_runtime_is_not_verified() -> None:
    entry = {"version": None, "status": "not run", "reason": "not installed; pip install x"}
    report = ParityReport("p", None, 0, 2, "numpy", {"x": entry}, ())
    assert verdict(report) == "NOT VERIFIED: no independent runtime ran"
    assert (to_verify(report), not_run_line(report)) == (
        "pip install x",
        "not run here: x    (export-model runtimes says how to install them)",
    )


def test_many_policies_are_one_line() -> None:
    good = ParityReport("p", True, 0, 2, "numpy", {}, (comparison(passed=True), comparison(max_abs_diff=0.1)))
    bad = ParityReport("q", False, 0, 2, "numpy", {}, (comparison(),))
    assert whole_summary([good, good]) == "2 policies: 2 passed; worst |Δ| 5.0e-01: action of p, onnx in onnxruntime"
    assert whole_summary([good, bad]) == "2 policies: 1 passed, 1 failed (q)"


@pytest.mark.parametrize("columns", [80, 120, 160])
def test_what_the_terminal_shows_fits_it(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "saved_model:serving_default"
    long = comparison(format=name, runtime="onnxruntime-web@chromium", output="a_rather_long_name_of_an_output")
    report = ParityReport("p", False, 0, 2, "numpy", {}, (comparison(), long), {"onnx": 17_000})
    free = parity_table(report)
    monkeypatch.setenv("COLUMNS", str(columns))
    for text in (parity_table(report), comparison_table(report)):
        assert max(map(len, text.splitlines())) <= columns
        assert all(
            line.startswith(("FAIL ", "verdict", "-------", "   ")) or " in " in line
            for line in text.split("\n")
            if line
        )
    assert columns < 120 or parity_table(report) == free


def test_honest_actors_change_nothing() -> None:
    answer: dict[str, Array] = {"a": np.ones(1)}
    assert honest("onnx", "onnxruntime", answer) is answer


def test_a_policy_without_noise_has_one_deterministic_signature(exporting: Exporting, tmp_path: Path) -> None:
    (tmp_path / "plain.bytes").write_bytes(graph_bytes(continuous_policy()))
    report = report_of(exporting(tmp_path / "plain.bytes"))
    assert report.passed is True
    assert {c.format for c in report.comparisons} >= {"saved_model", "saved_model:deterministic"}


# ------------------------------------------------------------------ what the source has no tensor for


def _head(kind: str) -> list[NodeDef]:
    """The end of a discrete policy, from ``logits`` on."""
    ends = {
        "probabilities": [node("action", "Softmax", "logits")],
        "log-probabilities": [node("p", "Softmax", "logits"), node("action", "Log", "p")],
        "log-softmax": [node("action", "LogSoftmax", "logits")],
        "argmax": [constant("axis", 1), node("action", "ArgMax", "logits", "axis", output_type=np.int64)],
        "narrow argmax": [constant("axis", 1), node("action", "ArgMax", "logits", "axis", output_type=np.int32)],
        "rounded": [node("action", "Cast", "logits", SrcT=np.float32, DstT=np.int32)],
        "draw": [constant("one", 1), node("action", "Multinomial", "logits", "one", output_dtype=np.int64)],
    }
    return ends[kind]


@pytest.mark.parametrize(
    ("kind", "role", "companions"),
    [
        ("probabilities", "probs", {"deterministic_action"}),
        ("log-probabilities", "log_probs", {"deterministic_action"}),
        ("log-softmax", "log_probs", {"deterministic_action"}),
        ("argmax", "deterministic", {"deterministic_action"}),
        ("narrow argmax", "deterministic", {"deterministic_action"}),
        ("rounded", "deterministic", {"deterministic_action"}),
        ("draw", "sampled", {"deterministic_action", "action_log_probs"}),
    ],
)
def test_companions_are_what_follows_from_the_sources_own_numbers(
    kind: str, role: str, companions: set[str], exporting: Exporting, tmp_path: Path
) -> None:
    nodes = [placeholder("vector_observation"), *dense("logits", "vector_observation", 3, 4), *_head(kind)]
    (tmp_path / "own.bytes").write_bytes(graph_bytes(nodes))
    result = exporting(tmp_path / "own.bytes")
    action, *others = result.policy.signature.outputs
    assert (action.role, {s.name for s in others}) == (role, companions)
    assert result.passed is True
    compared = {c.output for c in report_of(result).comparisons if c.format == "bytes" and c.kind == "numbers"}
    assert compared >= companions


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_a_source_that_takes_some_rows_only_is_asked_in_parts(rows: int) -> None:
    """Old LSTM exports are right at batch 1 only."""
    signature = PolicySignature(
        (
            TensorSpec("state", Role.VECTOR, "float32", (None, 3), "x:0"),
            TensorSpec("gain", Role.PARAMETER, "float32", (2,)),
        ),
        (TensorSpec("action", Role.CONTINUOUS, "float32", (None, 3), "y:0"),),
        *("own model", "continuous"),
    )
    asked: list[int] = []

    class Model:
        def run(self, feeds: Tensors, fetch: list[str]) -> Tensors:
            asked.append(len(feeds["x:0"]))
            return {"y:0": 2 * feeds["x:0"]}

    source = SourceMap({"state": "x:0"}, {"action": "y:0"}, rows=rows)
    original = Original(Model(), signature, source)  # type: ignore[arg-type]
    state = np.arange(21, dtype=np.float32).reshape(7, 3)
    np.testing.assert_array_equal(original.run({"state": state, "gain": np.ones(2)})["action"], 2 * state)
    assert asked == [rows] * -(-7 // rows)


# ------------------------------------------------------------------ an action without chance


def test_an_action_without_chance_that_is_drawn_is_refused(exporting: Exporting, tmp_path: Path) -> None:
    """However little: every runtime draws the same shape and range, so no comparison would see it."""
    nodes = [
        *continuous_policy(),
        constant("drawn/shape", np.array([1, 2], np.int32)),
        node("drawn/uniform", "RandomUniform", "drawn/shape", T=np.dtype(np.int32), dtype=np.dtype(np.float32)),
        node("deterministic_action", "Add", "action", "drawn/uniform", T=np.dtype(np.float32)),
    ]
    source = tmp_path / "drawn.bytes"
    source.write_bytes(graph_bytes(nodes))
    with pytest.raises(SignatureError, match="drawn/uniform"):
        exporting(source)


def test_verification_by_itself_fails_an_action_without_chance_that_is_drawn() -> None:
    """Where a graph comes to it that no compiler of ours has seen."""
    spec = TensorSpec("deterministic_action", Role.DETERMINISTIC, "float32", (None, 1))
    signature = PolicySignature((), (spec,), "test", "continuous")
    found = plausible(signature, spec.name, np.zeros((2, 1), np.float32), Case("zeros", 2, {}))
    assert not found.passed
    assert "without chance, and it is drawn" in found.reason
