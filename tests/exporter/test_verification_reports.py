"""What a report of a verification says: in JSON, to the terminal, and of a policy without noise."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.exporter.reports.summary import (
    comparison_table,
    failure_lines,
    not_run_line,
    parity_table,
    to_verify,
    whole_summary,
)
from export_model.exporter.verify.findings import Accepted, Failure, Finding, Numbers
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.tolerances import Tolerance
from export_model.exporter.verify.verdict import verdict
from tests.exporter.rehearsal import (
    Array,
    Exporting,
    honest,
    report_of,
)
from tests.handmade import continuous_policy, graph_bytes

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
        "share": 0.5,
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
    assert "0.50 action" in parity_table(report)
    assert "5.00e-01" in comparison_table(report)


def test_a_report_without_an_independent_runtime_is_not_verified() -> None:
    entry = {"version": None, "status": "not run", "reason": "not installed; pip install x"}
    report = ParityReport("p", None, 0, 2, "numpy", {"x": entry}, ())
    assert verdict(report) == "NOT VERIFIED: no independent runtime ran"
    assert (to_verify(report), not_run_line(report)) == (
        "pip install x",
        "not run here: x    (export-model runtimes says how to install them)",
    )


def test_what_the_own_kernels_alone_read_back_is_said() -> None:
    nn = comparison(format="nn", runtime="numpy", passed=True)
    report = ParityReport("p", None, 0, 2, "source/tensorflow", {}, (nn,), original="tensorflow")
    agrees = "; read back by export-model's own kernels, nn agrees with the original in TensorFlow"
    assert verdict(report) == f"NOT VERIFIED: no independent runtime ran nn{agrees}"
    of_consumer = replace(report, comparisons=(comparison(Accepted, format="nn", runtime="R20", passed=True), nn))
    assert verdict(of_consumer) == f"ACCEPTED by Unity's checks (release 20){agrees}"
    beside = replace(of_consumer, comparisons=(*of_consumer.comparisons, comparison(Failure, format="onnx")))
    assert verdict(beside).endswith("; no numbers of onnx were compared in any runtime")
    itself = replace(report, original=None, reference="nn/numpy")
    assert verdict(itself) == "NOT VERIFIED: no independent runtime ran nn; nn answered in export-model's own kernels"


def test_a_loader_is_named_as_it_is_called() -> None:
    accepted = comparison(Accepted, runtime="Godot RL Agents", passed=True)
    report = ParityReport("p", None, 0, 2, "numpy", {}, (accepted,))
    assert verdict(report).startswith("ACCEPTED by the loader rules of Godot RL Agents; ")


def test_many_policies_are_one_line() -> None:
    good = ParityReport("p", True, 0, 2, "numpy", {}, (comparison(passed=True), comparison(share=0.1)))
    bad = ParityReport("q", False, 0, 2, "numpy", {}, (comparison(),))
    assert whole_summary([good, good]) == (
        "2 policies: 2 passed; at most 0.50 of the tolerance: action of p, onnx in onnxruntime"
    )
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
