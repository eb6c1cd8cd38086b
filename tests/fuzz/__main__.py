"""``python -m tests.fuzz``: damaged files of every kind, and how often what came of them. ``make fuzz`` runs it.

A mutant has a number and is the same every time; ``--keep NUMBER --reader NAME`` writes it to a folder.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tests.fuzz.run import GOOD, Result, run
from tests.fuzz.seeds import READERS, mutant


def main() -> int:
    """1 where anything failed."""
    arguments = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    arguments.add_argument("--count", type=int, default=20_000, help="mutants of each reader")
    arguments.add_argument("--first", type=int, default=0, help="the number of the first")
    arguments.add_argument("--reader", action="append", choices=READERS, help="only this one; may be given again")
    arguments.add_argument("--keep", type=int, metavar="NUMBER", help="write this mutant to build/fuzz, and end")
    given = arguments.parse_args()
    readers = given.reader or list(READERS)
    if given.keep is not None:
        folder = Path("build/fuzz", f"{readers[0]} {given.keep}".replace(" ", "-"))
        for name, data in mutant(readers[0], given.keep).items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        print(folder / READERS[readers[0]].main)
        return 0
    failed = 0
    print("| reader | mutants | refused | converted | failures | slowest | minutes |\n|---|---|---|---|---|---|---|")
    for reader in readers:
        begun = time.monotonic()
        result = run([reader], given.first, given.count)
        failed += len(result.failures)
        print(row(result, time.monotonic() - begun), flush=True)
        for often, what, number in result.grouped():
            print(f"    {often} times, first {number}: {what}", file=sys.stderr, flush=True)
    return 1 if failed else 0


def row(result: Result, seconds: float) -> str:
    """A row of the table."""
    bad = ", ".join(f"{count} {kind}" for kind, count in sorted(result.counts.items()) if kind not in GOOD) or "0"
    return (
        f"| {result.reader} | {sum(result.counts.values())} | {result.counts['refused']} | {result.counts['ok']} "
        f"| {bad} | {result.slowest:.2f} s | {seconds / 60:.1f} |"
    )


if __name__ == "__main__":
    sys.exit(main())
