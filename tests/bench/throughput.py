"""``python -m tests.bench.throughput``: policies a second, of many distinct sources, by one process and by several.

The sources are all of ../shared/corpus and ../shared/genuine, as often as are asked for, each copy a file of its own
content where the format allows it. A figure is of a whole call of the command line: wall time, the processor's time of
its processes (which a busy machine leaves nearly as it is), the memory of the largest of them, and what the first
one and its workers have on the way.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from export_model.exporter.fleet.sources import sources_in
from tests.bench.plot import Line, plot

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared"
PAGE, PLOT = ROOT / "docs" / "figures.md", ROOT / "docs" / "pictures" / "throughput.svg"
BEGIN, END = "<!-- throughput: written by python -m tests.bench.throughput --write -->\n", "<!-- /throughput -->\n"
#: Numbers of policies at which memory is looked at.
MARKS = (200, 1000, 2000)
#: What is verified in → policies a second on two cores that are aimed at.
AIMS = {"none": 80, "numpy,onnxruntime": 15, "numpy,onnxruntime,tfjs-wasm": 10}


@dataclass(frozen=True)
class Measured:
    """One call."""

    verify: str
    jobs: int
    sources: int
    policies: int
    wall: float
    processor: float
    peak_mib: float
    #: (policies, MiB of the first process, of its workers)
    memory: tuple[tuple[int, float, tuple[float, ...]], ...] = ()

    @property
    def milliseconds(self) -> float:
        """Of the processor, for a policy."""
        return 1000 * self.processor / self.policies

    @property
    def rate(self) -> float:
        """Policies a second of wall time."""
        return self.policies / self.wall


def copies(folder: Path, count: int) -> list[Path]:
    """So many sources: those of ../shared in turn, in folders that are numbered."""
    found = sources_in([SHARED / "corpus", SHARED / "genuine"], folder)
    made = []
    for number in range(count):
        source = found[number % len(found)]
        target = folder / f"{number // len(found):04}" / source.relative_to(SHARED)
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, dirs_exist_ok=True)
        else:
            data = source.read_bytes()
            target.write_bytes(data + _distinct(data, source.suffix, f"copy {number}"))
        made.append(target)
    return made


def _distinct(data: bytes, suffix: str, text: str) -> bytes:
    """What can be appended to a file without another meaning: a model's doc_string, a node that nothing reads."""
    said = text.encode()
    if suffix == ".onnx":
        return bytes([6 << 3 | 2, len(said)]) + said
    if suffix in (".bytes", ".pb") and data.startswith(b"\n"):  # a GraphDef
        node = bytes([1 << 3 | 2, len(said)]) + said + bytes([2 << 3 | 2, 4]) + b"NoOp"
        return bytes([1 << 3 | 2, len(node)]) + node
    return b""


def measured(sources: Sequence[Path], verify: str, jobs: int, scratch: Path) -> Measured:
    """Export them all with the command line; raises RuntimeError where it fails."""
    out, listed = scratch / "out", scratch / "sources.txt"
    shutil.rmtree(out, ignore_errors=True)
    listed.write_text("".join(f"{p}\n" for p in sources))
    command = [
        sys.executable,
        "-m",
        "export_model",
        str(listed),
        "-o",
        str(out),
        "--verify",
        verify,
        "--jobs",
        str(jobs),
    ]
    with tempfile.TemporaryFile() as said:
        start = time.perf_counter()
        process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=said, stderr=said)
        status, used, memory = _watched(process.pid, out)
        wall = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        text = said.read().decode()
    policies = re.search(r"(\d+) polic(?:y|ies) exported", text)
    if process.returncode or policies is None:
        raise RuntimeError(text[-2000:])
    processor = used.ru_utime + used.ru_stime
    return Measured(verify, jobs, len(sources), int(policies[1]), wall, processor, used.ru_maxrss / 1024, memory)


def _watched(pid: int, out: Path) -> tuple[int, Any, tuple[tuple[int, float, tuple[float, ...]], ...]]:
    """How a process ended, what it used, and what it and its children had in memory when so many bundles were there."""
    seen: list[tuple[int, float, tuple[float, ...]]] = []
    while True:
        ended, status, used = os.wait4(pid, os.WNOHANG)
        if ended:
            return status, used, tuple(seen)
        if len(seen) < len(MARKS) and out.is_dir():
            count = sum(not path.name.startswith(".") for path in out.iterdir())
            if count >= MARKS[len(seen)]:
                workers = " ".join(_lines(f"/proc/{pid}/task/{pid}/children")).split()
                seen.append((count, _resident(str(pid)), tuple(map(_resident, workers))))
        time.sleep(0.2)


def _resident(pid: str) -> float:
    """MiB of a process."""
    return sum(int(line.split()[1]) / 1024 for line in _lines(f"/proc/{pid}/status") if line.startswith("VmRSS:"))


def runs(count: int, verified: int, jobs: Sequence[int]) -> Iterator[Measured]:
    """All calls, one after the other; the first tells the memory of a tenth as many."""
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        sources = copies(scratch / "sources", count)
        yield measured(sources[: count // 10], "none", jobs[-1], scratch)
        for verify in AIMS:
            for number in jobs:
                yield measured(sources if verify == "none" else sources[:verified], verify, number, scratch)


def row(found: Measured) -> str:
    return (
        f"| {found.verify} | {found.jobs} | {found.policies} | {found.rate:.1f} | {found.milliseconds:.1f} "
        f"| {2000 / found.milliseconds:.1f} | {AIMS[found.verify]} | {found.peak_mib:.0f} |"
    )


def memory_of(found: Measured) -> list[str]:
    """A sentence for the least and the largest number of policies at which it was looked at."""
    return [
        f"{count} policies, `--jobs {found.jobs}`, verified in {found.verify}: {first:.0f} MiB, its workers "
        f"{' and '.join(f'{w:.0f}' for w in workers) or 'none'}"
        for count, first, workers in (*found.memory[:1], *found.memory[1:][-1:])
    ]


HEAD = (
    "| verified in | `--jobs` | policies | a second, measured | processor, ms a policy | a second by two whole cores "
    "| aim | largest process, MiB |\n|---|---|---|---|---|---|---|---|"
)


def machine(busy: float) -> str:
    """What it was measured on."""
    told = [line.partition(":")[2].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")]
    versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "onnx", "onnxruntime"))
    return (
        f"{told[0] if told else platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"{versions}; "
        f"processes that wanted to run, on average: {busy:.1f}"
    )


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text().splitlines()
    except OSError:
        return []


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.throughput", description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, help="sources")
    parser.add_argument("--verified", type=int, default=400, help="sources of those that are verified, too")
    parser.add_argument("--jobs", default="1,2", help="numbers of processes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here too")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name} and its plot")
    options = parser.parse_args()
    if not SHARED.is_dir():
        print("not measured: ../shared is not here")
        return 0
    print(HEAD)
    found = []
    for each in runs(options.count, options.verified, [int(n) for n in options.jobs.split(",")]):
        found.append(each)
        print(row(each), flush=True)
        for text in memory_of(each):
            print(text, flush=True)
    if options.json:
        options.json.write_text(json.dumps([asdict(f) for f in found], indent=1) + "\n")
    if options.write:
        arguments = f"--count {options.count} --verified {options.verified} --jobs {options.jobs} --write"
        write(found, f"python -m tests.bench.throughput {arguments}", machine(os.getloadavg()[2]))
    return 0


def write(found: Sequence[Measured], command: str, where: str) -> None:
    """The section of the page, and the plot."""
    lines = [
        Line(f"verified in {verify}", [(f.jobs, f.rate) for f in found[1:] if f.verify == verify]) for verify in AIMS
    ]
    PLOT.write_text(plot(lines, "processes (--jobs)", "policies a second"), encoding="utf-8")
    table = "\n".join([HEAD, *map(row, found)])
    section = (
        f"{BEGIN}\n{where}. `{command}`\n\n{table}\n\n![Policies a second against jobs](pictures/{PLOT.name})\n\n{END}"
    )
    text = PAGE.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    PAGE.write_text(f"{before}{section}{rest.partition(END)[2]}", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
