"""``python -m tests.figures``: how far apart the runtimes are, by kind of policy.

It writes docs/figures.json and docs/figures.md. Every frozen graph of ../shared/genuine and ../shared/corpus is
exported to four formats and verified in all runtimes that are installed; in browsers too with ``--browsers``. The page
says nothing that depends on the machine's place or speed.
``python -m tests.figures --profiles`` counts what each profile of ``--for`` holds and refuses, and runs what is held
(tests/targets/sweep.py, 35 minutes of a processor),
``python -m tests.figures --litert`` counts what is written as .tflite, and runs it (tests/litert/sweep.py, 15 minutes),
``python -m tests.figures --programs`` the same of source code in C, C# and JavaScript (tests/programs/sweep.py),
``python -m tests.figures --page`` writes the page anew from the figures that are there.
"""

from __future__ import annotations

import argparse
import datetime
import itertools
import json
import statistics
import string
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from export_model.converters.runtimes.pool import INDEPENDENT, RuntimePool
from export_model.converters.runtimes.registry import RUNTIMES, available_runtimes
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.verify.difference import add_histograms, by_decade
from export_model.exporter.verify.findings import Finding
from export_model.exporter.verify.report import ParityReport
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature
from tests.corpus.conftest import SHARED, frozen_corpus, genuine_cases
from tests.faults.page import section

DOCS = Path(__file__).resolve().parent.parent / "docs"
FIGURES, PAGE = DOCS / "figures.json", DOCS / "figures.md"
#: Where the part of the page begins that this does not write.
REST = "## Speed and size\n"
KINDS = {
    "continuous": "continuous actions, vectors only",
    "discrete": "discrete actions, vectors only",
    "cameras": "cameras",
    "memory": "LSTM memory",
    "sac": "SAC",
}
FORMATS = ("bytes", "saved_model", "tfjs", "onnx")


def kind_of(signature: PolicySignature) -> str:
    """One of KINDS: what is hardest about the policy decides."""
    if signature.algorithm == "SAC":
        return "sac"
    if signature.memory is not None:
        return "memory"
    if any(s.role is Role.VISUAL for s in signature.inputs):
        return "cameras"
    return "continuous" if signature.action_space == "continuous" else "discrete"


#: Where it is from, policy, kind, report.
_Measured = tuple[str, str, str, ParityReport]


@dataclass
class Cell:
    """All comparisons of one format in one runtime over the policies of one kind."""

    policies: set[str] = field(default_factory=set)
    comparisons: int = 0
    failures: int = 0
    #: Policy → its worst difference; outputs that have a tolerance of their own are in ``apart``.
    worst: dict[str, float] = field(default_factory=dict)
    apart: dict[str, float] = field(default_factory=dict)
    rounding: int = 0
    draws: int = 0
    least_p: float = 1.0
    elements: tuple[int, ...] = ()

    def add(self, policy: str, comparison: Finding) -> None:
        self.policies.add(policy)
        self.comparisons += 1
        self.failures += not comparison.passed
        if comparison.kind == "draws":
            self.draws += 1
            self.least_p = min(self.least_p, 1 - comparison.max_abs_diff)
            return
        self.rounding += bool(comparison.rounding)
        place, key = (self.apart, comparison.output) if comparison.tolerance.reason else (self.worst, policy)
        place[key] = max(place.get(key, 0.0), comparison.max_abs_diff)
        self.elements = add_histograms([self.elements, comparison.histogram])

    def to_dict(self) -> dict[str, Any]:
        return {
            "policies": len(self.policies),
            "comparisons": self.comparisons,
            "failures": self.failures,
            "worst": _three(max(self.worst.values(), default=0.0)),
            "median": _three(statistics.median(self.worst.values() or [0.0])),
            "apart": {output: _three(worst) for output, worst in sorted(self.apart.items())},
            "rounding": self.rounding,
            "draws": self.draws,
            "least_p": _three(self.least_p),
            "elements": by_decade(self.elements) if self.elements else {},
        }


def _three(value: float) -> float:
    """Three digits; more depend on the processor."""
    return float(f"{value:.3g}")


def sources() -> list[tuple[str, Path]]:
    """(where it is from, file) of every frozen graph."""
    genuine = [("genuine", folder / case["frozen"]["file"]) for folder, case in genuine_cases()]
    return [*genuine, *(("corpus", path) for path in frozen_corpus())]


def measured(files: Sequence[tuple[str, Path]], runtimes: Sequence[str]) -> Iterator[_Measured]:
    """(where from, policy, kind, report) of each policy."""
    with RuntimePool() as pool:
        for number, (origin, file) in enumerate(files, 1):
            with tempfile.TemporaryDirectory() as scratch:
                for result in export([file], ExportOptions(Path(scratch), verify=runtimes), pool=pool):
                    assert result.report is not None
                    signature = result.policy.signature
                    yield origin, f"{number}/{result.policy.name}", kind_of(signature), result.report
            print(f"{number} of {len(files)}: {file.name}", file=sys.stderr, flush=True)


def _today() -> str:
    return datetime.datetime.now(tz=datetime.UTC).date().isoformat()


def figures(files: Sequence[tuple[str, Path]], runtimes: Sequence[str]) -> dict[str, Any]:
    """Everything that is measured, as JSON."""
    cells: dict[tuple[str, str, str], Cell] = defaultdict(Cell)
    versions: dict[str, str] = {}
    counts: dict[str, int] = defaultdict(int)
    kinds: dict[str, int] = defaultdict(int)
    failed: list[str] = []
    for origin, policy, kind, report in measured(files, runtimes):
        counts[origin] += 1
        kinds[kind] += 1
        if report.passed is not True:
            failed.append(policy)
        for comparison in report.comparisons:
            cells[kind, comparison.format, comparison.runtime].add(policy, comparison)
        versions.update({n: str(e["version"]) for n, e in report.runtimes.items() if e["status"] == "ran"})
    return {
        "date": _today(),
        "files": len(files),
        "policies": dict(counts),
        "kinds": {k: kinds[k] for k in KINDS if kinds[k]},
        "failed": failed,
        "runtimes": {r.name: versions[r.name] for r in RUNTIMES if r.name in versions},
        "cells": [{"kind": k, "format": f, "runtime": r, **c.to_dict()} for (k, f, r), c in sorted(cells.items())],
    }


# ------------------------------------------------------------------ the page


def _number(value: float) -> str:
    return "0" if value == 0 else f"{value:.1e}".replace("e-0", "e-").replace("e+0", "e+")


def _worst(cell: Mapping[str, Any] | None) -> str:
    return "" if cell is None else f"{_number(cell['worst'])}/{_number(cell['median'])}"


def _row(cells: Iterable[object]) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def _table(head: Sequence[object], rows: Iterable[Sequence[object]]) -> list[str]:
    return [_row(head), "|" + "---|" * len(head), *map(_row, rows), ""]


def _joined(rows: Iterable[Sequence[object]], column: int) -> list[list[object]]:
    """Rows that differ in one column alone as one row, with all that they have there."""
    found: dict[tuple[object, ...], list[str]] = {}
    for row in rows:
        found.setdefault((*row[:column], *row[column + 1 :]), []).append(str(row[column]))
    return [[*rest[:column], ", ".join(names), *rest[column:]] for rest, names in found.items()]


def _by_runtime(rows: Iterable[Sequence[object]]) -> list[list[object]]:
    """Rows that begin with a format and a runtime, those that say the same as one."""
    return _joined(_joined(rows, 1), 0)


def counted(content: Mapping[str, Any]) -> tuple[int, int]:
    """Return (comparisons, failures) in independent runtimes, which the front page quotes."""
    cells = [c for c in content["cells"] if c["runtime"] in INDEPENDENT]
    return sum(c["comparisons"] for c in cells), sum(c["failures"] for c in cells)


def page(content: Mapping[str, Any]) -> str:
    """docs/figures.md."""
    cells = {(c["kind"], c["format"], c["runtime"]): c for c in content["cells"]}
    order = [r for r in content["runtimes"] if r != "numpy"]
    rows = [(f, r) for f in FORMATS for r in order if any((k, f, r) in cells for k in KINDS)]
    kinds = list(content["kinds"])
    origins, others = content["policies"], [r for r in order if r in INDEPENDENT]
    comparisons, failures = counted(content)
    apart: dict[tuple[str, str], float] = {}
    for cell in content["cells"]:
        for output, worst in cell["apart"].items():
            apart[cell["kind"], output] = max(worst, apart.get((cell["kind"], output), 0.0))
    lines = [
        "# Figures",
        "",
        "<!-- Written by: python -m tests.figures, down to the part on speed. Do not edit. -->",
        "",
        f"Measured on {content['date']} by `python -m tests.figures`: {content['files']} frozen graphs, which are "
        f"{sum(origins.values())} policies ({origins.get('genuine', 0)} written by the trainers of "
        f"ML-Agents 0.3 to 0.22, with the random weights that training begins with, and "
        f"{origins.get('corpus', 0)} trained ones from public repositories), each exported to four "
        f"formats and run in {len(others)} independent runtimes. {comparisons:,} comparisons, {failures} failures. "
        "The reference is TensorFlow running the original file; what is fed, and what counts as agreement, is in "
        "[agreement.md](agreement.md).",
        "",
        "## Worst difference",
        "",
        "The largest |a − b| of any element of any output, over all inputs: also those of ±1e3, where outputs are "
        "thousands and the bound is relative. Behind the stroke the median of the policies' own worst.",
        "",
        *_table(
            ["format", "runtime", *(f"{KINDS[k]} ({content['kinds'][k]})" for k in kinds)],
            _by_runtime([f, r, *(_worst(cells.get((k, f, r))) for k in kinds)] for f, r in rows),
        ),
        *(
            ["Not in the table, as they have a tolerance of their own: " + "; ".join(own) + ".", ""]
            if (own := [f"`{o}` of {KINDS[k]}, at most {_number(w)}" for (k, o), w in apart.items()])
            else []
        ),
        "## Elements by size of the difference",
        "",
        "Of all elements compared, how many differ by how much; the last column counts the outputs that "
        "passed by what float32 rounding was measured to explain.",
        "",
        *_table(
            ["format", "runtime", "elements", "equal/below 1e-6/below 1e-5/above", "by rounding"],
            _by_runtime([f, r, *_spread([cells[k, f, r] for k in kinds if (k, f, r) in cells])] for f, r in rows),
        ),
        "## Draws",
        "",
        "Actions drawn inside the graph are held against their distribution; the false alarm rate is 1e-6 a test. The "
        f"smallest p: {'; '.join(_draws(cells, kinds, rows))}.",
        "",
        f"**Runtimes.** {'; '.join(_versions(content['runtimes']))}.",
        "",
        *(_profiles(content["unity"]) if "unity" in content else []),
        *(_litert(content["litert"]) if "litert" in content else []),
        *(_litert_web(content["litert-web"]) if "litert-web" in content else []),
        *(_programs(content["programs"]) if "programs" in content else []),
        *(section(content["faults"]) if "faults" in content else []),
    ]
    return "\n".join(lines).rstrip() + "\n\n"


def _draws(
    cells: Mapping[tuple[str, str, str], Mapping[str, Any]], kinds: Sequence[str], rows: Sequence[tuple[str, str]]
) -> Iterator[str]:
    """Of each format, how many tests there were in each runtime, and the smallest p."""
    for format, of in itertools.groupby(rows, lambda row: row[0]):
        drawn = {r: [c for k in kinds if (c := cells.get((k, format, r))) and c["draws"]] for _, r in of}
        tests = {sum(c["draws"] for c in found) for found in drawn.values() if found}
        least = (f"{r} {_number(min(c['least_p'] for c in found))}" for r, found in drawn.items() if found)
        if tests:
            yield f"{format} ({' or '.join(map(str, sorted(tests)))} tests each) {', '.join(least)}"


def _versions(runtimes: Mapping[str, str]) -> Iterator[str]:
    """Each version, behind the runtimes that have it."""
    for version, of in itertools.groupby(runtimes, lambda name: runtimes[name]):
        yield f"{', '.join(of)} {version}"


def write(content: Mapping[str, Any]) -> None:
    """Put the figures into the page, and leave the rest of it."""
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page(content) + text[text.index(REST) :], encoding="utf-8")


def _profiles(counted: Mapping[str, Any]) -> list[str]:
    """The section on ``--for``."""
    reasons = dict.fromkeys(why for c in counted["profiles"] for why in c["refused"])
    letters = dict(zip(reasons, string.ascii_lowercase, strict=False))
    unread = sum(counted["unread"].values())
    return [
        "## Unity",
        "",
        f"Counted on {counted['date']} by `python -m tests.figures --profiles`: {counted['files']} files and folders "
        f"(public models, genuine trainings, other trainers), of which {unread} are not read as a policy; the others "
        f"hold {counted['policies']}. *Held* is written, has nothing that an importer of that profile misreads, is "
        "accepted by our checkers of its releases, and acts as the policy does under that consumer's names, with 1, 3 "
        "and 16 agents: ONNX in onnxruntime, `.bytes` in TensorFlow 1.4 and 1.7, `.nn` by the layer rules.",
        "",
        *_table(
            ["`--for`", "format", "held", "refused, by the reasons below"],
            _joined(
                [
                    [
                        f"`{c['profile']}`",
                        c["format"],
                        c["held"],
                        ", ".join(f"{n} {letters[why]}" for why, n in c["refused"].items()),
                    ]
                    for c in counted["profiles"]
                ],
                0,
            ),
        ),
        "; ".join(f"{letter}: {why}" for why, letter in letters.items()) + ".",
        "",
        "Not read: " + "; ".join(f"{why}: {n}" for why, n in counted["unread"].items()) + ".",
        "",
    ]


def _litert(counted: Mapping[str, Any]) -> list[str]:
    """The section on ``--to litert``."""
    refused = "; ".join(f"{what}: {n}" for what, n in counted["refused"].items()) or "none"
    return [
        "## LiteRT",
        "",
        f"Counted on {counted['date']} by `python -m tests.figures --litert`, on {counted['files']} of these files: "
        f"{counted['onnx']} policies are written as ONNX, {counted['written']} as `.tflite`, {counted['agree']} agree "
        f"in LiteRT, with XNNPACK and without, {counted['same']} are the same bytes when read and written again. "
        f"Refused: {refused}. Not in agreement: {', '.join(counted['failed']) or 'none'}.",
        "",
    ]


def _litert_web(counted: Mapping[str, Any]) -> list[str]:
    """What LiteRT.js answers, below the section on ``--to litert``."""
    refused = "; ".join(f"{what}: {n}" for what, n in counted["refused"].items()) or "none"
    return [
        f"LiteRT.js in Chromium (`python -m tests.figures --litert-web`, {counted['date']}): {counted['agree']} of "
        f"{counted['onnx']} agree, {counted['one']} for one agent, those that draw classes for 64. "
        f"Refused: {refused}. Not in agreement: {', '.join(counted['failed']) or 'none'}.",
        "",
    ]


def _programs(counted: Mapping[str, Any]) -> list[str]:
    """The section on source code."""
    rows = counted["keys"]
    refused = "; ".join(f"{key}: {what}: {n}" for key, c in rows.items() for what, n in c["refused"].items())
    return [
        "## Source code",
        "",
        f"Counted on {counted['date']} by `python -m tests.figures --programs`, on the same {counted['files']} files: "
        f"{counted['onnx']} policies that are written as ONNX, {counted['memory']} with a memory. *Agree*: decisions, "
        "masks, memory over steps, and draws by distribution.",
        "",
        *_table(
            ["`--to` (compiled and run by)", "written", "agree", "with draws", "the original ran beside it"],
            _joined(
                [
                    [f"`{key}` ({counted['judges'][key]})", c["written"], c["agree"], c["draws"], c["original"]]
                    for key, c in rows.items()
                ],
                0,
            ),
        ),
        f"Refused: {refused or 'none'}. "
        f"Not in agreement: {', '.join(f for c in rows.values() for f in c['failed']) or 'none'}.",
        "",
    ]


def _spread(found: Sequence[Mapping[str, Any]]) -> list[object]:
    counts: dict[float, int] = defaultdict(int)
    for cell in found:
        for decade, count in cell["elements"].items():
            counts[float(decade)] += count
    total = sum(counts.values())
    below = [sum(n for d, n in counts.items() if 0 < d < edge) for edge in (0.99e-6, 0.99e-5)]
    equal, above = counts[0.0], total - counts[0.0] - below[1]
    share = [f"{n / total:.3%}" if n else "0" for n in (equal, below[0], below[1] - below[0], above)]
    return [f"{total:,}", "/".join(share), sum(c["rounding"] for c in found)]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.figures", description=__doc__.splitlines()[0])
    parser.add_argument("--browsers", action="store_true", help="also the runtimes in Chromium")
    parser.add_argument("--only", default="", help="only files whose path holds this; nothing is written to docs/")
    parser.add_argument("--page", action="store_true", help="only the page, from the figures that are there")
    parser.add_argument("--profiles", action="store_true", help="only what each profile of --for holds")
    parser.add_argument("--litert", action="store_true", help="only what is written as .tflite")
    parser.add_argument("--litert-web", action="store_true", help="only what LiteRT.js answers in Chromium")
    parser.add_argument("--programs", action="store_true", help="only what is written as source code")
    options = parser.parse_args()
    before = json.loads(FIGURES.read_text(encoding="utf-8")) if FIGURES.is_file() else {}
    if options.profiles:
        from tests.targets import sweep

        with RuntimePool() as pool:
            counted = {"date": _today(), **sweep.swept(sweep.sources(), pool)}
        FIGURES.write_text(json.dumps({**before, "unity": counted}, indent=1) + "\n", encoding="utf-8")
    elif options.litert:
        from tests import known
        from tests.litert import sweep as litert

        with RuntimePool() as pool:
            found = {"date": _today(), **litert.sweep(known.sources(), pool)}
        FIGURES.write_text(json.dumps({**before, "litert": found}, indent=1) + "\n", encoding="utf-8")
    elif options.litert_web:
        from tests import known
        from tests.litert import sweep as litert

        with RuntimePool() as pool:
            found = {"date": _today(), **litert.sweep_web(known.sources(), pool)}
        FIGURES.write_text(json.dumps({**before, "litert-web": found}, indent=1) + "\n", encoding="utf-8")
    elif options.programs:
        from tests import known
        from tests.programs import sweep as programs

        with RuntimePool() as pool:
            found = {"date": _today(), **programs.sweep(known.sources(), pool)}
        FIGURES.write_text(json.dumps({**before, "programs": found}, indent=1) + "\n", encoding="utf-8")
    elif not options.page:
        files = [(origin, f) for origin, f in sources() if options.only in str(f)]
        if not files or not SHARED.is_dir():
            print("not measured: ../shared is not beside this checkout")
            return 0
        automatic = {r.name for r in RUNTIMES if r.taken_by == "auto" or (options.browsers and r.browser)}
        content = figures(files, [i.name for i in available_runtimes() if i.installed and i.name in automatic])
        if options.only:
            print(page(content))
            return 1 if content["failed"] else 0
        kept = {key: before[key] for key in ("unity", "litert", "litert-web", "programs", "faults") if key in before}
        FIGURES.write_text(json.dumps({**content, **kept}, indent=1) + "\n", encoding="utf-8")
    content = json.loads(FIGURES.read_text(encoding="utf-8"))
    write(content)
    print(f"wrote {PAGE.relative_to(DOCS.parent)}; failed: {', '.join(content['failed']) or 'none'}")
    return 1 if content["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
