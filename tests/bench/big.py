"""``python -m tests.bench.big``: what a large policy costs against its size: time by megabyte, memory by byte.

Whole processes that write four formats, started cold; each policy is made, exported, and deleted with what was written.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import sys
import tempfile
from pathlib import Path

from tests.bench.big_policies import KINDS
from tests.bench.measure import Cost, measure
from tests.peers.environment import environment

SIZES = (50, 200, 770, 1500)
TARGET = 2.0


def export_of(kind: str, megabytes: float, verify: str, scratch: Path) -> tuple[int, Cost]:
    """(bytes of the source, what exporting it cost)."""
    source, out = scratch / "policy.onnx", scratch / "out"
    made = [sys.executable, "-m", "tests.bench.big_policies", kind, str(megabytes), str(source)]
    measure(made, environment())
    try:
        command = [sys.executable, "-m", "export_model", str(source), "-o", str(out), "--verify", verify]
        cost = measure(command, environment())
        return sum(f.stat().st_size for f in scratch.glob("policy.onnx*")), cost
    finally:
        shutil.rmtree(out, ignore_errors=True)
        for file in scratch.glob("policy.onnx*"):
            file.unlink()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.big", description=__doc__.splitlines()[0])
    parser.add_argument("--kind", action="append", choices=sorted(KINDS), help="only sources of this kind (repeatable)")
    parser.add_argument("--megabytes", action="append", type=float, help="only this size (repeatable)")
    parser.add_argument("--verify", default="none", help="as export-model has it")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here too")
    options = parser.parse_args()
    print(f"Python {platform.python_version()}, {platform.system()} {platform.machine()}, {os.cpu_count()} cores")
    print(f"four formats, --verify {options.verify}; aimed at: a peak of at most {TARGET} times the source\n")
    print(f"{'source':10}{'MB':>8}{'wall s':>9}{'cpu s':>8}{'cpu ms/MB':>11}{'peak MiB':>10}{'peak/source':>13}")
    figures = []
    with tempfile.TemporaryDirectory() as scratch:
        for kind in options.kind or ("frozen", "onnx"):
            for megabytes in options.megabytes or SIZES:
                size, cost = export_of(kind, megabytes, options.verify, Path(scratch))
                ratio = cost.peak_mib * 2**20 / size
                each = cost.processor * 1e9 / size
                print(
                    f"{kind:10}{size / 1e6:>8.0f}{cost.seconds:>9.1f}{cost.processor:>8.1f}{each:>11.1f}"
                    f"{cost.peak_mib:>10.0f}{ratio:>13.2f}",
                    flush=True,
                )
                figures.append({"kind": kind, "bytes": size, "peak_ratio": ratio, **vars(cost)})
    if options.json:
        options.json.write_text(json.dumps({"schema": 1, "exports": figures}, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
