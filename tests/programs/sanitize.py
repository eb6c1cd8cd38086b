"""``python -m tests.programs.sanitize``: every policy of ../shared as C, under ASan and UBSan.

A line of JSON for each file goes to ``build/sanitized.jsonl``; files that stand there are not run again.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from export_model.converters.runtimes.c import compiler
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.signatures.errors import ExportModelError
from tests import known
from tests.programs.mains import c_main, called

LINES = Path(__file__).resolve().parents[2] / "build" / "sanitized.jsonl"
FLAGS = ("-std=c99", "-O1", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all",
         "-Wall", "-Wextra", "-Wconversion", "-Werror")  # fmt: skip


def judge(file: Path, cc: str, scratch: Path) -> Iterator[tuple[str, str]]:
    """Of each policy of a file its name, and what is wrong with its C. Raises ExportModelError."""
    for result in export([file], ExportOptions(scratch, ("c",), verify="none")):
        (result.folder / "main.c").write_text(c_main(called(result.policy)), "ascii")
        built = subprocess.run([cc, *FLAGS, "-o", "main", "main.c", "-lm"], cwd=result.folder, capture_output=True)
        if built.returncode:
            yield result.policy.name, built.stderr.decode(errors="replace")[:400]
            continue
        ran = subprocess.run([str(result.folder / "main")], cwd=result.folder, capture_output=True)
        missed = "golden numbers are missed" * (b"missed" in ran.stdout)
        said = f"{ran.returncode} {ran.stderr.decode(errors='replace')[:400]}" * (ran.returncode != 0)
        yield result.policy.name, missed or said


def line(file: Path, cc: str) -> dict[str, Any]:
    """The line of a file; ``policies`` by name, each with what is wrong, or nothing."""
    record: dict[str, Any] = {"file": str(file.relative_to(known.SHARED))}
    with tempfile.TemporaryDirectory() as scratch:
        try:
            record["policies"] = dict(judge(file, cc, Path(scratch)))
        except ExportModelError as error:
            record["refused"] = error.what
    return record


def sweep(files: Sequence[Path], cc: str, kept: Path = LINES) -> list[dict[str, Any]]:
    """The lines of all files; those that ``kept`` has are taken from there."""
    kept.parent.mkdir(exist_ok=True)
    before = {r["file"]: r for r in map(json.loads, kept.read_text().splitlines())} if kept.is_file() else {}
    with kept.open("a") as out:
        for file in files:
            name = str(file.relative_to(known.SHARED))
            if name not in before:
                before[name] = line(file, cc)
                out.write(json.dumps(before[name]) + "\n")
                out.flush()
    return [before[str(f.relative_to(known.SHARED))] for f in files]


def main() -> int:
    """Print the counts, and what was found; 1 where there is anything."""
    cc = compiler()
    if cc is None:
        print("not run: no C compiler is installed")
        return 0
    policies = [(r["file"], *p) for r in sweep(known.sources(), cc) for p in r.get("policies", {}).items()]
    found = [p for p in policies if p[2]]
    print(f"{len(policies)} policies under ASan and UBSan: {len(found)} with a finding")
    for file, name, what in found:
        print(f"    {file} {name}: {what}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
