"""``python -m tests.corpus.false_alarms``: how often verification calls something wrong that is right.

Every model file of ../shared/genuine is exported to four formats and verified in every runtime that is installed (no
browser), once per seed. None of them has a fault, so every failed comparison is a false alarm. It prints a line per
alarm and the figures, and ends with status 1 where there was one. Files that are refused (one .nn is known to compute
something else than was trained) are counted apart. ``--rooms genuine,corpus,corpus4,foreign`` has all of ../shared,
``--to`` other formats, and ``--minutes`` as many as there is time for, in an order of chance.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.report import ParityReport
from export_model.signatures.errors import ExportModelError
from tests.known import SHARED, sources

GENUINE = Path(__file__).resolve().parents[3] / "shared" / "genuine"
SEEDS = tuple(range(10))


def model_files(rooms: Sequence[str]) -> list[Path]:
    """Every model file of these rooms of ../shared."""
    every = [p for p in sources() if p.relative_to(SHARED).parts[0] in rooms and "genuine" not in p.parts]
    others = [p for p in sorted((SHARED / "corpus4").glob("*")) if p.suffix != ".jsonl"]
    return [*(genuine_files() if "genuine" in rooms else ()), *every, *(others if "corpus4" in rooms else ())]


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


def verified(
    source: Path, seed: int, pool: RuntimePool, runtimes: str = "auto", formats: Sequence[str] | None = None
) -> list[ParityReport]:
    """The reports on the policies of one file."""
    with tempfile.TemporaryDirectory() as scratch:
        options = ExportOptions(Path(scratch), formats, verify=runtimes, parity=VerifyOptions(seed=seed))
        return [r.report for r in export([source], options, pool=pool) if r.report is not None]


def alarms(report: ParityReport) -> list[str]:
    """What was called wrong; an unverified policy counts as well."""
    return failure_lines(report) if report.passed is not None else ["  not verified"]


def measured(
    given: Sequence[tuple[int, Path]], runtimes: str = "auto", formats: Sequence[str] | None = None
) -> Iterator[dict[str, object]]:
    """One record per seed and file."""
    with RuntimePool() as pool:
        for seed, source in given:
            start = time.monotonic()
            where = "/".join(source.parts[-2:])
            count = pairs = 0
            try:
                reports = verified(source, seed, pool, runtimes, formats)
                pairs = sum(len(r.pairs) for r in reports)
                found, refused = [line for report in reports for line in alarms(report)], None
                count = sum(len(r.comparisons) for r in reports)
            except ExportModelError as error:
                found, refused, count = [], error.what, 0
            seconds = round(time.monotonic() - start, 2)
            yield {
                "seed": seed,
                "source": where,
                "pairs": pairs,
                "comparisons": count,
                "alarms": found,
                "refused": refused,
                "seconds": seconds,
            }


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.corpus.false_alarms", description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="how many seeds, from 0 on")
    parser.add_argument("--only", default="", help="only files whose path holds this")
    parser.add_argument("--runtimes", default="auto", help="as --verify: only these, comma-separated")
    parser.add_argument("--records", type=Path, metavar="FILE", help="write a JSON record per file and seed here")
    parser.add_argument("--rooms", default="genuine", help="folders of ../shared, comma-separated")
    parser.add_argument("--to", help="formats, comma-separated")
    parser.add_argument("--minutes", type=float, help="stop then, and take files and seeds by chance")
    options = parser.parse_args()
    found = [s for s in model_files(options.rooms.split(",")) if options.only in str(s)]
    if not found:
        print("not measured: ../shared is not beside this checkout")
        return 0
    given, end = list(product(range(options.seeds), found)), math.inf
    if options.minutes is not None:
        random.Random(0).shuffle(given)
        end = time.monotonic() + 60 * options.minutes
    formats = options.to and options.to.split(",")
    runs = pairs = comparisons = wrong = 0
    refused: set[str] = set()
    seconds = 0.0
    for record in measured(given, options.runtimes, formats):
        if time.monotonic() > end:
            break
        runs += 1
        pairs += int(str(record["pairs"]))
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
        f"{len(found)} files, {options.seeds} seeds: {runs} verifications, {pairs} of a format in a runtime, "
        f"{comparisons} comparisons, {wrong} alarms"
    )
    print(f"{seconds:.0f} s; refused: {', '.join(sorted(refused)) or 'none'}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
