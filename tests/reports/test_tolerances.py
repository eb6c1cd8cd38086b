"""``--tolerances FILE``: what it may say, and what it changes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.tolerance_file import read_tolerances
from export_model.exporter.verify.tolerances import Tolerance, ToleranceRule, tolerance_by_rules
from export_model.signatures.errors import UsageError
from fixtures import path as fixture
from tests.commands import export_model, is_refused
from tests.exporter.rehearsal import ActingPool, Tensors, export

GOOD = """
[[tolerance]]
output = "value_estimate"
runtime = "onnxruntime"
atol = 1e-3
reason = "sums in   another order"

[[tolerance]]
format = "tfjs"
rtol = 1
reason = "all of it"
"""


def written(tmp_path: Path, text: str, name: str = "t.toml") -> Path:
    (tmp_path / name).write_text(text)
    return tmp_path / name


def test_toml_and_json_say_the_same(tmp_path: Path) -> None:
    rules = read_tolerances(written(tmp_path, GOOD))
    assert rules == (
        ToleranceRule(Tolerance(1e-3, 1e-5, "sums in another order"), None, None, "onnxruntime", "value_estimate"),
        ToleranceRule(Tolerance(1e-5, 1.0, "all of it"), None, "tfjs"),
    )
    entries = [
        {"output": "value_estimate", "runtime": "onnxruntime", "atol": 1e-3, "reason": "sums in another order"},
        {"format": "tfjs", "rtol": 1, "reason": "all of it"},
    ]
    assert read_tolerances(written(tmp_path, json.dumps({"tolerance": entries}), "t.json")) == rules


def test_the_last_rule_that_covers_a_comparison_decides() -> None:
    loose, tight = Tolerance(1, 1, "loose"), Tolerance(0, 0, "tight")
    rules = (ToleranceRule(loose), ToleranceRule(tight, format="saved_model", output="action", policy="a"))
    assert tolerance_by_rules(rules, "a", "saved_model:deterministic", "tensorflow", "action") == tight
    assert tolerance_by_rules(rules, "b", "saved_model", "tensorflow", "action") == loose
    assert tolerance_by_rules(rules, "a", "onnx", "onnxruntime", "action") == loose
    assert tolerance_by_rules((), "a", "onnx", "onnxruntime", "action") is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[tolerance]]\natol = 1", "gives no reason"),
        ('[[tolerance]]\natol = 1\nreason = "  "', "gives no reason"),
        ('[[tolerance]]\nreason = "x"', "neither atol nor rtol"),
        ('[[tolerance]]\natol = -1\nreason = "x"', "atol is -1"),
        ('[[tolerance]]\natol = inf\nreason = "x"', "atol is inf"),
        (f'[[tolerance]]\natol = 1{"0" * 400}\nreason = "x"', "atol is 1000"),
        ('[[tolerance]]\natol = true\nreason = "x"', "atol is True"),
        ('[[tolerance]]\natol = 1\nruntime = "tensorfow"\nreason = "x"', "unknown runtime 'tensorfow'"),
        ('[[tolerance]]\natol = 1\nformat = "pb"\nreason = "x"', "unknown format 'pb'"),
        ('[[tolerance]]\natol = 1\noutput = 3\nreason = "x"', "output must be a name"),
        ('[[tolerance]]\natoll = 1\nreason = "x"', "unknown key 'atoll'"),
        ("tolerance = [1]", "is not a table"),
        ("x = 1", "a list called tolerance"),
        ("[[[", "neither TOML nor JSON"),
    ],
)
def test_what_is_incomplete_is_refused(text: str, words: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    with pytest.raises(UsageError, match=words) as caught:
        read_tolerances(path)
    assert str(path) in str(caught.value)


def test_the_command_line_refuses_before_it_writes(tmp_path: Path) -> None:
    path = written(tmp_path, "[[tolerance]]\natol = 1\n")
    is_refused(export_model(fixture("continuous"), "-o", tmp_path / "o", "--tolerances", path), "gives no reason")
    assert not (tmp_path / "o").exists()


def test_a_rule_lets_pass_what_it_covers_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(kind: str, runtime: str, answer: Tensors) -> Tensors:
        moved = {"value_estimate"} if kind in ("onnx", "tfjs") else set()
        return {n: a + np.float32(1e-2) * abs(a) + np.float32(1e-2) if n in moved else a for n, a in answer.items()}

    rules = (ToleranceRule(Tolerance(0.1, 0.1, "measured"), output="value_estimate", format="onnx"),)
    result = export(monkeypatch, fixture("continuous"), tmp_path, ActingPool(spoil), parity=VerifyOptions(rules=rules))[
        0
    ]
    assert result.report is not None
    assert {c.format for c in result.report.failures} == {"tfjs"}
    told = [c for c in result.report.to_dict()["comparisons"] if "tolerance_reason" in c]
    assert {(c["format"], c["output"], c["atol"], c["tolerance_reason"]) for c in told} == {
        ("onnx", "value_estimate", 0.1, "measured")
    }
