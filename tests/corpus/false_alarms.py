"""``python -m tests.corpus.false_alarms``: how often verification calls something wrong that is right.

Every model file of ../shared/genuine is exported to four formats and verified in every runtime that is installed (no
browser), once per seed. None of them has a fault, so every failed comparison is a false alarm. It prints a line per
alarm and the figures, and ends with status 1 where there was one. Files that are refused (one .nn is known to compute
something else than was trained) are counted apart.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.report import ParityReport
from export_model.signatures.errors import SourceError

GENUINE = Path(__file__).resolve().parents[3] / "shared" / "genuine"
SEEDS = tuple(range(10))


def seed_of(source: Path) -> int:
    """A seed of its own for each file: the tests that verify all of them look with many."""
    return zlib.crc32("/".join(source.parts[-2:]).encode()) % len(SEEDS)


def genuine_files(folder: Path = GENUINE) -> list[Path]:
    """Frozen graphs, .nn and .onnx of all cases, the frozen graphs first."""
    frozen = [
        folder / case.parent.name / content["frozen"]["file"]
        for case in sorted(folder.glob("*/case.json"))
        if (content := json.loads(case.read_text())).get("frozen", {}).get("file")
    ]
    return [*frozen, *sorted(folder.glob("*/*.nn")), *sorted(folder.glob("*/*.onnx"))]


def verified(source: Path, seed: int, pool: RuntimePool, runtimes: str = "auto") -> list[ParityReport]:
    """The reports on the policies of one file."""
    with tempfile.TemporaryDirectory() as scratch:
        options = ExportOptions(Path(scratch), verify=runtimes, parity=VerifyOptions(seed=seed))
        return [r.report for r in export([source], options, pool=pool) if r.report is not None]


def alarms(report: ParityReport) -> list[str]:
    """What was called wrong; an unverified policy counts as well."""
    return failure_lines(report) if report.passed is not None else ["  not verified"]


def measured(sources: Sequence[Path], seeds: Sequence[int], runtimes: str = "auto") -> Iterator[dict[str, object]]:
    """One record per file and seed, seed by seed."""
    with RuntimePool() as pool:
        for seed in seeds:
            for source in sources:
                start = time.monotonic()
                where = "/".join(source.parts[-2:])
                try:
                    reports = verified(source, seed, pool, runtimes)
                    found, refused = [line for report in reports for line in alarms(report)], None
                    count = sum(len(r.comparisons) for r in reports)
                except SourceError as error:
                    found, refused, count = [], error.what, 0
                seconds = round(time.monotonic() - start, 2)
                yield {"seed": seed, "source": where, "comparisons": count, "alarms": found, "refused": refused,
                       "seconds": seconds}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.corpus.false_alarms", description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="how many seeds, from 0 on")
    parser.add_argument("--only", default="", help="only files whose path holds this")
    parser.add_argument("--runtimes", default="auto", help="as --verify: only these, comma-separated")
    parser.add_argument("--records", type=Path, metavar="FILE", help="write a JSON record per file and seed here")
    options = parser.parse_args()
    sources = [s for s in genuine_files() if options.only in str(s)]
    if not sources:
        print("not measured: ../shared/genuine is not beside this checkout")
        return 0
    runs = comparisons = wrong = 0
    refused: set[str] = set()
    seconds = 0.0
    for record in measured(sources, range(options.seeds), options.runtimes):
        runs += 1
        comparisons += int(str(record["comparisons"]))
        seconds += float(str(record["seconds"]))
        refused |= {str(record["source"])} if record["refused"] else set()
        lines = record["alarms"]
        assert isinstance(lines, list)
        wrong += len(lines)
        for line in lines:
            print(f"{record['source']}, seed {record['seed']}:{line}", flush=True)
        if options.records:
            with options.records.open("a", encoding="utf-8") as file:
                file.write(json.dumps(record) + "\n")
    print(
        f"{len(sources)} files, {options.seeds} seeds: {runs} verifications, {comparisons} comparisons, {wrong} alarms"
    )
    print(f"{seconds:.0f} s; refused: {', '.join(sorted(refused)) or 'none'}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
