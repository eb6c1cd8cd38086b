"""A proof of some formats says so: nobody who reads a report anywhere finds that four formats passed."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from msgspec.structs import replace

from export_model.exporter.cli.console import _colour
from export_model.exporter.export import job
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify.findings import Accepted
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.verdict import verdict
from fixtures import FOLDER
from fixtures import path as fixture
from tests.commands import export_model, is_refused
from tests.reports.made import FAILING, PASSING, comparison

REST = ("bytes", "saved_model", "tfjs")
WORDS = "onnx (1 of 4 formats; "
RUNTIMES = {"onnxruntime": ("ran", None), "tensorflow": ("not run", "not installed; pip install tensorflow")}


@pytest.mark.parametrize("command", ["export", "verify"])
def test_no_report_says_that_what_did_not_run_passed(command: str, tmp_path: Path) -> None:
    out, told = tmp_path / "out", {}
    files = {flag: tmp_path / f"report.{flag}" for flag in ("junit", "markdown", "html")}
    reports = [word for flag, file in files.items() for word in (f"--{flag}", file)]
    first = ("--verify" if command == "export" else "--runtimes", "onnxruntime")
    export_model(fixture("continuous"), "-o", out, "--verify", "none" if command == "verify" else "onnxruntime")
    given = [out / "continuous"] if command == "verify" else [fixture("continuous"), "-o", out]
    ran = export_model(command, *given, *first, *reports)
    assert ran.status == 0
    told["terminal"] = ran.out
    told |= {flag: file.read_text(encoding="utf-8") for flag, file in files.items()}
    answer = export_model(command, *given, *first, "--json").json
    report = answer["reports"][0] if command == "verify" else answer["policies"][0]["parity"]
    assert (report["passed"], report["partial"], report["original"]) == (True, True, None)
    assert report["unchecked"] == list(REST)
    told["json"] = json.dumps(report, ensure_ascii=False)
    sentence = report["sentence"].partition(": ")[2]
    assert sentence.startswith(WORDS)
    for form, text in told.items():
        plain = re.sub(r"\\(?=[()_])", "", text).replace("&#x27;", "'")
        assert sentence[1:].removesuffix(".") in plain, form  # a page begins it with a capital letter
        assert "4 of 4" not in plain and "pairs agree" not in plain, form
    assert "reference" not in {c["format"] for c in report["comparisons"]}
    assert {c["format"] for c in report["comparisons"]} == {"onnx"}
    for case in ET.fromstring(told["junit"]).iter("testcase"):
        assert case.find("skipped") is not None or ".onnx.onnxruntime" in str(case.get("classname"))
    assert "✅" not in told["markdown"]  # green only where the original ran
    assert 'class="chip passed"' not in told["html"]


@pytest.mark.parametrize(
    ("required", "status"), [("all", 3), ("onnx", 0), ("onnx,tfjs", 3), ("nn", 3), ("onnx,tfj", 2), ("", 2)]
)
@pytest.mark.parametrize("many", [False, True])
def test_what_is_required_must_have_been_checked(required: str, status: int, many: bool, tmp_path: Path) -> None:
    given = [fixture("continuous"), *(["--jobs", "1"] if many else [])]
    ran = export_model(*given, "-o", tmp_path, "--verify", "onnxruntime", "--require", required)
    assert ran.status == status, (ran.out, ran.err)
    if status == 3:
        missing = next(k for k in ("tfjs", "nn") if k in required or required == "all")
        assert re.search(rf"{missing}.* required, and not checked", ran.out + ran.err)
        assert "PASSED" not in ran.out
    if not many and status != 2:
        again = export_model("verify", tmp_path / "continuous", "--runtimes", "onnxruntime", "--require", required)
        assert again.status == status


@pytest.mark.parametrize("rest", [("--verify", "none"), ("--allow-unverified",)])
def test_to_require_and_to_allow_nothing_is_refused(rest: tuple[str, ...], tmp_path: Path) -> None:
    bundle = () if rest[0] == "--verify" else ("verify",)
    is_refused(export_model(*bundle, fixture("continuous"), "--require", "all", *rest), "--require all")


def made(**more: object) -> ParityReport:
    states = {name: {"version": None, "status": s, "reason": r} for name, (s, r) in RUNTIMES.items()}
    sizes = dict.fromkeys(("bytes", "saved_model", "onnx"), 1)
    comparisons = (comparison("onnx", "onnxruntime"),)
    plain = replace(PASSING, runtimes=states, sizes=sizes, comparisons=comparisons)
    return replace(plain, **more)  # type: ignore[arg-type]


def test_the_verdict_is_a_sentence_that_is_true() -> None:
    head = "PASSED: onnx (1 of 3 formats; install tensorflow to check the others) agrees with "
    assert verdict(made()) == f"{head}the original in TensorFlow"
    unasked = made(original=None, reference="numpy")
    assert verdict(unasked) == f"{head}the original as export-model reads it, which was not run"
    alone = replace(unasked, self_consistent=True)
    assert verdict(alone).startswith("SELF-CONSISTENT: onnx (1 of 3 formats; install tensorflow ")
    assert verdict(alone).endswith("which nothing else here can run")
    assert [_colour([r]) for r in (made(), unasked, alone, FAILING)] == ["green", "yellow", "yellow", "red"]
    said = tuple(comparison("onnx", n, "*", kind=Accepted) for n in ("R22", "R23", "R23-2.4"))
    unity = made(sizes={"onnx": 1}, comparisons=(comparison("onnx", "onnxruntime"), *said))
    assert verdict(unity) == (
        "PASSED: Unity's checks (releases 22, 23): accepted. onnxruntime: agrees, with the original in TensorFlow"
    )


def test_a_format_that_stands_alone_is_named() -> None:
    good = [comparison(kind, "tensorflow") for kind in ("bytes", "saved_model")]
    bad = comparison("onnx", "onnxruntime", passed=False, share=9.0)
    web = comparison("onnx", "onnxruntime-web")
    said = "FAILED: 1 of {} comparisons disagree with the original in TensorFlow"
    assert verdict(made(passed=False, comparisons=(*good, bad))) == (
        f"{said.format(3)}; onnx alone differs, bytes and saved_model agree"
    )
    assert verdict(made(passed=False, comparisons=(*good, bad, web))) == (
        f"{said.format(4)}; onnx in onnxruntime alone differs, bytes, saved_model and onnx in onnxruntime-web agree"
    )
    every = tuple(replace(c, passed=False) for c in (*good, bad))
    assert "alone" not in verdict(made(passed=False, comparisons=every))
    assert failure_lines(made(passed=False, comparisons=(bad,)))


@pytest.mark.parametrize("here", [False, True])
def test_a_source_that_its_own_library_runs_is_not_self_consistent(
    here: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job, "find_spec", lambda name: name if here else None)
    options = ExportOptions(tmp_path, verify="onnxruntime", targets=["onnx"])
    (result,) = export([FOLDER / "sb3_zip" / "ppo_box.zip"], options)
    assert result.report is not None
    assert result.report.verdict == ("passed" if here else "self-consistent")


@pytest.mark.runtimes
def test_the_original_runs_under_a_profile(tmp_path: Path) -> None:
    ran = export_model(fixture("continuous"), "-o", tmp_path, "--for", "unity6", "--verify", "onnxruntime,tensorflow")
    assert ran.status == 0
    assert ran.out.count("*") == 0
    assert (
        "PASSED: Unity's checks (releases 22, 23): accepted. onnxruntime: agrees, with the original in TensorFlow"
        in " ".join(ran.out.split())
    )


def test_the_note_on_unity_is_for_policies_of_ml_agents(tmp_path: Path) -> None:
    for source, told in ((FOLDER / "sb3" / "sb3_continuous.onnx", False), (fixture("continuous"), True)):
        ran = export_model(source, "-o", tmp_path, "--verify", "onnxruntime")
        assert ran.status == 0
        assert ("Unity" in ran.out.replace("/", " ")) is told
