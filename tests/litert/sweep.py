"""Every policy at hand as a .tflite: what is written, what acts alike in LiteRT, what comes back byte for byte.

``python -m tests.figures --litert`` writes the counts into docs/figures, ``--litert-web`` those of LiteRT.js. Of that a
line of JSON for each file goes to ``build/litert-web.jsonl``; files that stand there are not run again.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.formats.source import ReadOptions
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.job import contract_of
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify.options import VerifyOptions
from export_model.signatures.contract import safe_name
from export_model.signatures.errors import ExportModelError
from export_model.signatures.roles import Role
from tests import known

RUNTIMES = ("litert", "litert-plain")
WEB = "litert-web"
#: Agents that a file for LiteRT.js is made for; more where classes are drawn, which takes thousands of runs of one.
AGENTS, DRAWN_AGENTS = 1, 64
LINES = Path(__file__).resolve().parents[2] / "build" / "litert-web.jsonl"


def written(policy: Policy, text: str) -> bytes:
    """The file of a policy under a contract. Raises UnsupportedOpError."""
    (pieces,) = WRITTEN["litert"].artifact(policy, WriteOptions(text)).files.values()
    return pieces.to_bytes()


def write_again(file: Path, text: str) -> bytes:
    """What is written of a file that is read, under the same contract. Raises ExportModelError."""
    (policy,) = read_source(file).policies()
    return written(policy, text)


def round_trips(source: Path, folder: Path) -> Iterator[tuple[bytes, bytes]]:
    """Of each policy its file, and what is written of that file. Raises ExportModelError."""
    found, place = read_source(source), folder / "policy.tflite"
    for model, policy in found.compile_models(None):
        named = replace(policy, name=safe_name(policy.name))
        text = contract_of(named, found, model, ReadOptions()).compact()
        place.write_bytes(written(named, text))
        yield place.read_bytes(), write_again(place, text)


def sweep(files: Sequence[Path], pool: RuntimePool) -> dict[str, Any]:
    """The counts, as JSON."""
    counts: Counter[str] = Counter()
    refused: Counter[str] = Counter()
    failed: list[str] = []
    for number, file in enumerate(files, 1):
        print(f"{number} of {len(files)}: {file.name}", file=sys.stderr, flush=True)
        with tempfile.TemporaryDirectory() as scratch:
            try:
                known = list(export([file], ExportOptions(Path(scratch, "onnx"), ("onnx",), verify="none")))
            except ExportModelError:
                continue
            counts["files"] += 1
            counts["onnx"] += len(known)
            options = ExportOptions(Path(scratch, "litert"), ("litert",), verify=RUNTIMES, parity=VerifyOptions(seed=3))
            try:
                results = list(export([file], options, pool=pool))
            except ExportModelError as error:
                refused[error.what] += len(known)
                continue
            counts["written"] += len(results)
            for result in results:
                agrees = result.report is not None and result.report.passed is True
                counts["agree"] += agrees
                if not agrees:
                    failed.append(f"{file.parent.name}/{result.policy.name}")
            counts["same"] += sum(first == second for first, second in round_trips(file, Path(scratch)))
    return {**counts, "refused": dict(refused), "failed": failed}


def agents(source: Path) -> int:
    """How many agents a source's file for LiteRT.js is made for. Raises ExportModelError."""
    drawn = any(s.role is Role.SAMPLED for p in read_source(source).policies() for s in p.signature.outputs)
    return DRAWN_AGENTS if drawn else AGENTS


def _web_line(file: Path, pool: RuntimePool) -> dict[str, Any]:
    """What became of a file's policies in Chromium; without ``onnx`` where it is not written as ONNX."""
    record: dict[str, Any] = {"file": str(file.relative_to(known.SHARED)), "agree": 0, "failed": []}
    with tempfile.TemporaryDirectory() as scratch:
        try:
            onnx = list(export([file], ExportOptions(Path(scratch, "onnx"), ("onnx",), verify="none")))
        except ExportModelError:
            return record
        record |= {"onnx": len(onnx), "batch": agents(file)}
        options = ExportOptions(
            Path(scratch, "litert"),
            ("litert",),
            verify=(WEB,),
            batch=record["batch"],
            parity=VerifyOptions(seed=3),
        )
        try:
            for result in export([file], options, pool=pool):
                assert result.report is not None
                if result.report.passed is True:
                    record["agree"] += 1
                elif result.report.runtimes[WEB]["status"] != "ran":
                    record["refused"] = f"{WEB} {result.report.runtimes[WEB]['reason']}"
                else:
                    record["failed"].append({"policy": result.policy.name, "why": failure_lines(result.report)[:3]})
        except ExportModelError as error:
            record["refused"] = error.what
    return record


def sweep_web(files: Sequence[Path], pool: RuntimePool, kept: Path = LINES) -> dict[str, Any]:
    """The counts of LiteRT.js, as JSON; files that ``kept`` has are taken from there."""
    kept.parent.mkdir(exist_ok=True)
    before = {r["file"]: r for r in map(json.loads, kept.read_text().splitlines())} if kept.is_file() else {}
    with kept.open("a") as out:
        for number, file in enumerate(files, 1):
            name = str(file.relative_to(known.SHARED))
            if name not in before:
                print(f"{number} of {len(files)}: {name}", file=sys.stderr, flush=True)
                before[name] = _web_line(file, pool)
                out.write(json.dumps(before[name]) + "\n")
                out.flush()
    records = [r for r in (before[str(f.relative_to(known.SHARED))] for f in files) if "onnx" in r]
    refused: Counter[str] = Counter()
    for record in records:
        if "refused" in record:
            refused[record["refused"]] += record["onnx"]
    return {
        "onnx": sum(r["onnx"] for r in records),
        "agree": sum(r["agree"] for r in records),
        "one": sum(r["onnx"] for r in records if r["batch"] == AGENTS),
        "refused": dict(refused),
        "failed": [f"{Path(r['file']).parent.name}/{f['policy']}" for r in records for f in r["failed"]],
    }
