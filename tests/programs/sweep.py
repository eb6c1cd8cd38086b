"""Every policy at hand as source code: what is written, and what acts alike once a compiler or Node has it.

``python -m tests.figures --programs`` writes the counts into docs/figures. A line of JSON for each file goes to
``build/programs.jsonl``; files that stand there are not run again.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from export_model.converters.formats.registry import WRITTEN
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify.options import VerifyOptions
from export_model.signatures.errors import ExportModelError
from tests import known

KEYS = tuple(f.key for f in WRITTEN.values() if f.program)
#: Who compiles and runs each.
JUDGES = {"c": "gcc", "csharp": "mono", "js": "Node"}
LINES = Path(__file__).resolve().parents[2] / "build" / "programs.jsonl"
#: What runs sources themselves, so that a program is held against more than our own reading.
ORIGINALS = ("tensorflow", "onnxruntime")


def judge(file: Path, key: str, pool: RuntimePool, scratch: Path) -> dict[str, Any]:
    """What became of a file's policies as one language: counts, refusals by name, failures."""
    (runtime,) = WRITTEN[key].runtimes
    options = ExportOptions(scratch, (key,), verify=(runtime, *ORIGINALS), parity=VerifyOptions(seed=3))
    try:
        results = list(export([file], options, pool=pool))
    except ExportModelError as error:
        return {"refused": error.what}
    found: dict[str, Any] = {"written": len(results), "agree": 0, "original": 0, "draws": 0, "failed": []}
    for result in results:
        report = result.report
        assert report is not None
        judged = [c for c in report.comparisons if c.runtime == runtime]
        found["draws"] += any(c.kind == "draws" for c in judged)
        found["original"] += report.original is not None
        if report.passed is True and judged:
            found["agree"] += 1
        else:
            found["failed"].append({"policy": result.policy.name, "why": failure_lines(report)[:3]})
    return found


def line(file: Path, keys: Sequence[str], pool: RuntimePool) -> dict[str, Any]:
    """The line of a file; without ``onnx`` where it is not read as a policy, or not written as ONNX."""
    record: dict[str, Any] = {"file": str(file.relative_to(known.SHARED)), "keys": {}}
    with tempfile.TemporaryDirectory() as scratch:
        try:
            policies = list(export([file], ExportOptions(Path(scratch, "onnx"), ("onnx",), verify="none")))
        except ExportModelError:
            return record
        record["onnx"] = len(policies)
        record["memory"] = sum(r.policy.signature.memory is not None for r in policies)
        for key in keys:
            record["keys"][key] = judge(file, key, pool, Path(scratch, key))
    return record


def lines(files: Sequence[Path], keys: Sequence[str], pool: RuntimePool, kept: Path) -> list[dict[str, Any]]:
    """The lines of all files; those that ``kept`` has are taken from there."""
    kept.parent.mkdir(exist_ok=True)
    known_lines = [json.loads(text) for text in kept.read_text().splitlines()] if kept.is_file() else []
    before = {record["file"]: record for record in known_lines}
    with kept.open("a") as out:
        for number, file in enumerate(files, 1):
            name = str(file.relative_to(known.SHARED))
            if name not in before:
                print(f"{number} of {len(files)}: {name}", file=sys.stderr, flush=True)
                before[name] = line(file, keys, pool)
                out.write(json.dumps(before[name]) + "\n")
                out.flush()
    return [before[str(file.relative_to(known.SHARED))] for file in files]


def count(records: Iterable[dict[str, Any]], keys: Sequence[str]) -> dict[str, Any]:
    """The counts, as JSON."""
    records = [r for r in records if "onnx" in r]
    found: dict[str, Any] = {
        "files": len(records),
        "onnx": sum(r["onnx"] for r in records),
        "memory": sum(r["memory"] for r in records),
        "keys": {},
    }
    for key in keys:
        refused: Counter[str] = Counter()
        counts: Counter[str] = Counter(dict.fromkeys(("written", "agree", "original", "draws"), 0))
        failed: list[str] = []
        for record in records:
            one = record["keys"][key]
            if "refused" in one:
                refused[one["refused"]] += record["onnx"]
                continue
            counts.update({name: one[name] for name in counts})
            failed += [f"{record['file']} {f['policy']}" for f in one["failed"]]
        found["keys"][key] = {**counts, "refused": dict(refused), "failed": failed}
    return found


def sweep(files: Sequence[Path], pool: RuntimePool) -> dict[str, Any]:
    """The counts of all files in all languages."""
    return {"judges": JUDGES, **count(lines(files, KEYS, pool, LINES), KEYS)}


def main() -> None:
    """``KEY,KEY… FILE``: the lines of some languages into a file."""
    keys, kept = sys.argv[1].split(","), Path(sys.argv[2])
    with RuntimePool() as pool:
        print(json.dumps(count(lines(known.sources(), keys, pool, kept), keys), indent=1))


if __name__ == "__main__":
    main()
