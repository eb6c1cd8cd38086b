"""``python -m tests.bench.verification``: what it costs to verify a bundle in every runtime but the browser's.

The yardstick is ``import tensorflow``, which one of the runtimes has to do anyway: verification should take at most
twice as long. Both are whole processes, measured in turn, because the speed of a machine wanders.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from tests.bench.measure import measure
from tests.peers.environment import environment

POLICY = Path(__file__).resolve().parents[2] / "fixtures" / "continuous.bytes"
TARGET = 2.0
ROUNDS = 5


@dataclass(frozen=True)
class Verification:
    """Seconds per round."""

    runtimes: Sequence[str]
    ours: Sequence[float]
    tensorflow: Sequence[float]

    @property
    def ratios(self) -> list[float]:
        return [ours / theirs for ours, theirs in zip(self.ours, self.tensorflow, strict=True)]


def installed_runtimes() -> list[str]:
    """The runtimes of this machine, browsers apart. Asked in another process: this one has to stay small."""
    program = (
        "import json; from export_model.converters.runtimes.registry import RUNTIMES;"
        "print(json.dumps([r.name for r in RUNTIMES if r.taken_by == 'auto' and r.find().installed]))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    names: list[str] = json.loads(done.stdout)
    return names


def run_verification(folder: Path, rounds: int = ROUNDS) -> Verification:
    """Export the policy into ``folder`` and measure; both commands run once before that, for the files' cache."""
    export_model, names = [sys.executable, "-m", "export_model"], installed_runtimes()
    env = environment()
    measure([*export_model, str(POLICY), "-o", str(folder), "--verify", "none"], env)
    verify = [*export_model, "verify", str(folder / POLICY.stem), "--runtimes", ",".join(names)]
    imports = [sys.executable, "-c", "import tensorflow"]
    ours, tensorflow = [], []
    for _ in range(rounds + 1):
        ours.append(measure(verify, env).seconds)
        tensorflow.append(measure(imports, env).seconds)
    return Verification(names, ours[1:], tensorflow[1:])


def report(found: Verification) -> str:
    ratios = found.ratios
    return "\n".join(
        [
            f"{POLICY.stem}, verified in {', '.join(found.runtimes)}: median of {len(ratios)} rounds",
            f"  verify                  {median(found.ours):>9.2f} s",
            f"  import tensorflow       {median(found.tensorflow):>9.2f} s",
            f"  ratio                   {median(ratios):>9.2f}x   {min(ratios):.2f} to {max(ratios):.2f}"
            f"   (aimed at: at most {TARGET:.0f}x)",
        ]
    )


def main() -> int:
    if "tensorflow" not in installed_runtimes():
        print("not measured: TensorFlow is not installed")
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        print(report(run_verification(Path(scratch))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
