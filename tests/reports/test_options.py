"""The options on output: reports to files, quiet, verbose, colours, progress."""

from __future__ import annotations

import io
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.exporter.cli.app import app
from export_model.exporter.cli.console import Console, Progress
from export_model.exporter.cli.options import JUDGING, as_given
from export_model.exporter.cli.verify import verify_command
from fixtures import path as fixture
from tests.commands import Ran, export_model, is_refused
from tests.exporter.rehearsal import ALL, KNOWN, ActingPool, Tensors

Exporting = Callable[..., Ran]


def spoil(kind: str, runtime: str, answer: Tensors) -> Tensors:
    return {n: a + np.float32(1) if kind == "onnx" and n == "value_estimate" else a for n, a in answer.items()}


@pytest.fixture
def exporting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Exporting:
    """The export command on a fixture, the runtimes played."""

    def run(*options: object, good: bool = True, command: tuple[object, ...] | None = None) -> Ran:
        pool = ActingPool() if good else ActingPool(spoil)
        for module in ("export_model.exporter.export.again", "export_model.converters.runtimes.pool"):
            monkeypatch.setattr(f"{module}.chosen_runtimes", lambda wanted, formats: (ALL, list(KNOWN)))
            monkeypatch.setattr(f"{module}.RuntimePool", lambda: pool)
        return export_model(*(command or (fixture("continuous"), "-o", tmp_path / "out")), *options)

    return run


@pytest.mark.parametrize("good", [True, False])
def test_all_reports_are_written_whatever_the_verdict(exporting: Exporting, tmp_path: Path, good: bool) -> None:
    folder = tmp_path / "deep" / "er"
    options = ("--junit", folder / "j.xml", "--markdown", folder / "m.md", "--html", folder / "h.html")
    ran = exporting(*options, good=good)
    assert ran.status == (0 if good else 1)
    assert int(ET.parse(folder / "j.xml").getroot().get("failures", "")) == (0 if good else 1)
    assert ("PASSED" if good else "FAILED") in (folder / "m.md").read_text(encoding="utf-8")
    assert ("Passed" if good else "What disagrees") in (folder / "h.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("command", ["export", "fleet", "verify"])
@pytest.mark.parametrize("sound", [0, 1])
@pytest.mark.parametrize("broken", [1, 2])
def test_what_is_refused_is_in_every_report(
    exporting: Exporting, tmp_path: Path, command: str, sound: int, broken: int
) -> None:
    exporting(command=(fixture("continuous"), fixture("discrete"), fixture("visual"), "-o", tmp_path / "in"))
    bundles = [tmp_path / "in" / name for name in ("continuous", "discrete", "visual")][: sound + broken]
    for bundle in bundles[sound:]:
        main = bundle / f"{bundle.name}.bytes"
        main.write_bytes(main.read_bytes()[:-300])
    sources: list[object] = [b if command == "verify" else b / f"{b.name}.bytes" for b in bundles]
    given = ("verify", *sources) if command == "verify" else (*sources, "-o", tmp_path / "out")
    reports = [tmp_path / name for name in ("j.xml", "m.md", "h.html")]
    for report in reports:
        report.write_text("of yesterday: all is well")
    flags = ("--junit", reports[0], "--markdown", reports[1], "--html", reports[2])
    ran = exporting(*flags, *(("--jobs", 1) if command == "fleet" else ()), command=given)
    assert ran.status == 2
    root = ET.parse(reports[0]).getroot()
    assert root.get("errors") == str(broken)
    errors = [case for case in root.iter("testcase") if case.find("error") is not None]
    words = [str(case[0].text) for case in errors]
    marked = [el for el in reports[2].read_text(encoding="utf-8").split("<section")[1:] if "chip failed" in el]
    for number, bundle in enumerate(bundles[sound:]):
        assert bundle.name in str(errors[number].get("classname")) and bundle.name in words[number]
        assert bundle.name in marked[number] and "Refused" in marked[number]
        assert f"### ❌ `{errors[number].get('classname')}`" in reports[1].read_text(encoding="utf-8")
    assert any(str(suite.get("name")).startswith("continuous.") for suite in root) == (sound == 1)


def test_no_report_of_an_earlier_run_is_left(
    exporting: Exporting, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = tmp_path / "j.xml"
    report.write_text("of yesterday: all is well")
    is_refused(exporting("--junit", report, "--to", "onyx"), "onyx")
    assert ET.parse(report).getroot().find("testsuite/testcase/error") is not None

    def stop(*given: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("export_model.exporter.cli.export._export_few", stop)
    report.write_text("of yesterday: all is well")
    summary = tmp_path / "summary.md"
    summary.write_text("of the step before\n")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(summary))
    assert exporting("--junit", report, "--markdown", summary).status == 130
    assert report.read_text() == "" and summary.read_text() == "of the step before\n"


def test_the_reports_of_an_export_say_how_it_was_judged(exporting: Exporting, tmp_path: Path) -> None:
    assert exporting("--html", tmp_path / "h.html", "--atol", "0.5", "--max-size", "1GB").status == 0
    again = (tmp_path / "h.html").read_text(encoding="utf-8").partition("To compare again")[2].partition("</code>")[0]
    assert "--atol 0.5" in again and "--max-size 1GB" in again


def test_an_address_is_told_without_its_password() -> None:
    secret = "https://user:pw@example.org/x.onnx?signature=s"
    with verify_command.make_context("verify", ["bundle", "--source", secret]):
        assert as_given(JUDGING) == ["--source", "https://example.org/x.onnx"]


def test_verify_writes_the_same_reports(exporting: Exporting, tmp_path: Path) -> None:
    assert exporting().status == 0
    bundle = tmp_path / "out" / "continuous"
    paths = [tmp_path / name for name in ("j.xml", "m.md", "h.html")]
    ran = exporting("--junit", paths[0], "--markdown", paths[1], "--html", paths[2], command=("verify", bundle, bundle))
    assert ran.status == 0
    assert len(ET.parse(paths[0]).getroot()) == 8
    assert paths[1].read_text(encoding="utf-8").count("### ") == 2
    assert "dense 64, swish" in paths[2].read_text(encoding="utf-8")


def test_a_folder_stands_for_the_bundles_in_it(exporting: Exporting, tmp_path: Path) -> None:
    exporting(command=(fixture("continuous"), fixture("discrete"), "-o", tmp_path / "out"))
    (tmp_path / "out" / "notes").mkdir()
    ran = exporting(command=("verify", tmp_path / "out"))
    assert ran.status == 0
    assert ran.out.splitlines()[-1].startswith("2 policies: 2 passed; at most ")
    assert ran.out.count(f": {tmp_path / 'out'}") == 2
    is_refused(exporting(command=("snippets", tmp_path / "out")), "holds 2 bundles", "snippets " + str(tmp_path))
    is_refused(exporting(command=("snippets", fixture("continuous"))), "not a bundle", "-o exported")


def test_markdown_on_stdout_is_all_that_is_there(exporting: Exporting) -> None:
    ran = exporting("--markdown", "-")
    assert ran.out.startswith("## export-model\n")
    assert "next:" not in ran.out


def test_what_contradicts_itself_is_refused(exporting: Exporting, tmp_path: Path) -> None:
    is_refused(exporting("--quiet", "--verbose"), "contradict")
    is_refused(exporting("--html", tmp_path / "x", "--verify", "none"), "needs a verification")
    is_refused(exporting("--html", tmp_path / "x", "--junit", tmp_path / "x"), "two reports")
    (tmp_path / "file").write_text("")
    is_refused(exporting("--html", tmp_path / "file" / "x"), "cannot be written")
    assert exporting("--html", tmp_path).status == 2
    assert "both want stdout" in exporting("--markdown", "-", "--json").err
    assert not (tmp_path / "out").exists()


def test_quiet_says_only_what_disagrees(exporting: Exporting) -> None:
    assert exporting("-q") == Ran(0, "", "")
    bad = exporting("-q", good=False)
    assert bad.status == 1
    assert "value_estimate differs by" in bad.out
    assert "FAILED" in bad.out
    assert "format " not in bad.out


def test_verbose_says_every_step_and_comparison(exporting: Exporting) -> None:
    ran = exporting("-v")
    assert "s  continuous: onnx in onnxruntime" in ran.err
    _, _, rows = ran.out.partition("\nonnx in onnxruntime\n")
    row = next(line for line in rows.splitlines() if "value_estimate" in line)
    assert row.startswith("ok  ")
    assert "numbers" in row


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("no_colour", ["", "1"])
def test_colour_is_for_terminals_that_want_it(
    exporting: Exporting, monkeypatch: pytest.MonkeyPatch, no_colour: str, tmp_path: Path
) -> None:
    plain = exporting()
    assert "\x1b" not in plain.out
    monkeypatch.setenv("NO_COLOR", no_colour)
    shown: Any = Terminal()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stdout", shown)
        app.main([str(fixture("continuous")), "-o", str(tmp_path / "out")], standalone_mode=False)
    assert ("\x1b[32mPASSED" in shown.getvalue()) is (no_colour == "")
    assert "PASSED" in shown.getvalue()


def test_progress_is_one_line_on_a_terminal_and_gone_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = Terminal()
    monkeypatch.setattr("sys.stderr", shown)
    monkeypatch.setenv("COLUMNS", "20")
    monkeypatch.setenv("TERM", "xterm")
    with pytest.raises(ValueError, match="stop"), Progress(quiet=False, verbose=False) as progress:
        progress("a step whose name is long")
        raise ValueError("stop")
    assert shown.getvalue() == "\r\x1b[2K  a step whose name\r\x1b[2K"
    with Console(quiet=True).progress() as progress:
        progress("nothing")
    assert shown.getvalue().endswith("\r\x1b[2K")
    assert "nothing" not in shown.getvalue()
