"""What verification compares where a graph has noise, fixed rows or no tensor for what is derived from it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.graph.run import run_graph
from export_model.exporter.reports.entry import Entry
from export_model.exporter.reports.markdown import markdown_text
from export_model.exporter.reports.page import page
from export_model.exporter.verify.checks.numbers import plausible
from export_model.exporter.verify.original import Original
from export_model.exporter.verify.verdict import verdict
from export_model.signatures.errors import SignatureError, UnsupportedOpError
from export_model.signatures.roles import Role
from export_model.signatures.sampling import Case
from export_model.signatures.spec import PolicySignature, SourceMap, TensorSpec
from tests.exporter.rehearsal import (
    ActingPool,
    Exporting,
    Tensors,
    report_of,
    spoiling,
)
from tests.handmade import NodeDef, constant, continuous_policy, dense, graph_bytes, node, placeholder
from tests.reports.validation import check_parity

# ------------------------------------------------------------------ what is compared


def test_without_bytes_a_reference_is_made_for_the_comparison(exporting: Exporting) -> None:
    result = exporting("continuous", targets=("onnx",))
    assert result.passed is True
    assert {c.format for c in report_of(result).comparisons} == {"reference", "onnx"}
    assert not list(result.folder.glob("*.bytes"))


@pytest.mark.slow
def test_noise_that_stays_in_the_graph_is_compared_by_numbers_and_distribution(exporting: Exporting) -> None:
    report = report_of(exporting("visual", compile=CompileOptions(noise="keep")))
    kinds = {(c.output, c.kind) for c in report.comparisons if c.format == "onnx"}
    numbers = {("deterministic_action", "numbers"), ("value_estimate", "numbers")}
    assert kinds == {("action", "shape"), ("action", "draws"), ("action", "numbers"), *numbers}


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
        inputs=(
            TensorSpec("state", Role.VECTOR, "float32", (None, 3), "x:0"),
            TensorSpec("gain", Role.PARAMETER, "float32", (2,)),
        ),
        outputs=(TensorSpec("action", Role.CONTINUOUS, "float32", (None, 3), "y:0"),),
        family="own model",
        action_space="continuous",
    )
    asked: list[int] = []

    class Model:
        def run_all(self, inputs: list[Tensors], fetch: list[str]) -> list[Tensors]:
            asked.extend(len(feeds["x:0"]) for feeds in inputs)
            return [{"y:0": 2 * feeds["x:0"]} for feeds in inputs]

    source = SourceMap({"state": "x:0"}, {"action": "y:0"}, rows=rows)
    original = Original(Model(), signature, source)  # type: ignore[arg-type]
    state = np.arange(21, dtype=np.float32).reshape(7, 3)
    np.testing.assert_array_equal(original.run({"state": state, "gain": np.ones(2)})["action"], 2 * state)
    assert asked == [rows] * -(-7 // rows)


def _epsilon_greedy() -> list[NodeDef]:
    """``action`` [B]: once in four times any of four classes, else the likeliest."""
    return [
        *(constant("axis", 1), constant("least", 0), constant("most", 4), constant("share", np.float32(0.25))),
        *(constant("begin", [0]), constant("end", [1])),
        node("whole", "Shape", "logits", out_type=np.int32),
        node("rows", "StridedSlice", "whole", "begin", "end", "end", Index=np.int32),
        node("any", "RandomUniformInt", "rows", "least", "most", Tout=np.int32, T=np.int32),
        node("best", "ArgMax", "logits", "axis", output_type=np.int32),
        node("u", "RandomUniform", "rows", dtype=np.float32),
        node("exploits", "GreaterEqual", "u", "share"),
        node("action", "Select", "exploits", "best", "any", T=np.int32),
    ]


_APART = "; compared between the formats, not with the source: "


@pytest.mark.parametrize(
    ("head", "noise", "apart"),
    [
        (_epsilon_greedy(), "lift", ["action_log_probs", "deterministic_action", "the draws of action"]),
        (_head("draw"), "lift", []),
        ([node("s", "Shape", "logits", out_type=np.int32), node("noise", "RandomStandardNormal", "s", dtype=np.float32),
          node("action", "Add", "logits", "noise")], "keep", ["the draws of action"]),
    ],
    ids=["epsilon-greedy", "logits", "numbers"],
)  # fmt: skip
def test_draws_of_which_the_source_has_no_odds_say_what_they_were_held_against(
    head: list[NodeDef], noise: Any, apart: list[str], exporting: Exporting, tmp_path: Path
) -> None:
    """The terminal, Markdown and HTML by the verdict, parity.json comparison by comparison; all others as before."""
    nodes = [placeholder("vector_observation"), *dense("logits", "vector_observation", 3, 4), *head]
    (tmp_path / "own.bytes").write_bytes(graph_bytes(nodes))
    result = exporting(tmp_path / "own.bytes", compile=CompileOptions(noise=noise))
    report = report_of(result)
    assert (result.passed, report.reference) == (True, "source/tensorflow"), [f.explanation() for f in report.failures]
    agreed, _, told = verdict(report).partition(_APART)
    assert sorted(told.split(", ")) == (apart or [""])
    assert agreed.endswith("agree with the original in TensorFlow")
    for text in (markdown_text([Entry(report)]).replace("\\", ""), page([Entry(report)])):
        assert text.count(_APART + told) == (1 if apart else 0)
    written = (result.folder / "parity.json").read_text(encoding="utf-8")
    check_parity(written)
    held = {c["output"] for c in json.loads(written)["comparisons"] if c.get("against") == "numpy"}
    assert held == {name.removeprefix("the draws of ") for name in apart}
    assert all(c.kind in ("draws", "numbers") for c in report.comparisons if c.against)
    failed = replace(report, passed=False, comparisons=tuple(replace(c, passed=False) for c in report.comparisons))
    assert verdict(failed).endswith(_APART + told if apart else "with the original in TensorFlow")


def test_without_a_source_that_runs_the_verdict_says_no_more_than_it_did(exporting: Exporting, tmp_path: Path) -> None:
    """It names the kernels as what all was compared with."""
    nodes = [placeholder("vector_observation"), *dense("logits", "vector_observation", 3, 4), *_epsilon_greedy()]
    (tmp_path / "own.bytes").write_bytes(graph_bytes(nodes))
    report = report_of(exporting(tmp_path / "own.bytes", ActingPool(refused=frozenset({("source", "tensorflow")}))))
    assert report.reference == "numpy"
    assert _APART not in verdict(report)
    assert not any("against" in c.to_dict() for c in report.comparisons)


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
    signature = PolicySignature(inputs=(), outputs=(spec,), family="test", action_space="continuous")
    found = plausible(signature, spec.name, np.zeros((2, 1), np.float32), Case("zeros", 2, {}))
    assert not found.passed
    assert "without chance, and it is drawn" in found.reason
