"""``python -m tests.hostile.kills [COUNT [SEED]]``: exports that are killed at moments drawn at random.

SIGKILL, SIGTERM and SIGINT, to the command alone or, as a terminal does, to its children too; over no bundle or an
older one; with runtimes that are quick, and with all. Afterwards: no bundle is torn, nobody of it lives after five
seconds (a minute in the tests: the machine may be busy), SIGTERM and SIGINT leave no folder and no traceback; the next
run is clean, and leaves nothing of a killed one.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from export_model.converters.formats.bundle.bundle import Bundle
from fixtures import path as fixture
from tests.commands import PYTHONPATH, ROOT, default_signals

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
#: Runtimes → one in so many runs.
RUNTIMES = {"numpy,onnxruntime": 1, "numpy,onnxruntime,tfjs-cpu,tfjs-wasm": 3, "auto": 8}
#: Environment variable by which the processes of a run are known.
_MARK = "EXPORT_MODEL_KILLED"


@dataclass
class Kills:
    """A folder to write to, and what came of the kills: faults with the draw that showed them."""

    home: Path
    faults: list[str]
    seen: Counter[str]
    #: runtimes → how long an export takes when it is let be
    spans: dict[str, float]
    #: seconds until all must be gone
    patience: float

    def one(self, number: int, rng: random.Random) -> None:
        """Start an export, kill it, look."""
        chosen = rng.choice([r for r, share in RUNTIMES.items() if number % share == 0])
        how, group = rng.choice(SIGNALS), rng.random() < 0.5
        out, temporary = self.home / "out", self.home / "tmp"
        if rng.random() < 0.5:
            shutil.rmtree(out, ignore_errors=True)
        temporary.mkdir(exist_ok=True)
        if chosen not in self.spans:
            begun = time.monotonic()
            assert _status(self._start(out, temporary, chosen, "whole")) == 0
            self.spans[chosen] = time.monotonic() - begun
        after = rng.uniform(0, self.spans[chosen] * 1.05)
        draw = f"#{number}: {how.name} {'to all' if group else 'to the command'} after {after:.3f} s, {chosen}"
        process = self._start(out, temporary, chosen, f"{number}")
        time.sleep(after)
        running = process.poll() is None
        self.seen[f"{how.name}, {'running' if running else 'ended before'}"] += 1
        if group:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, how)
        else:
            process.send_signal(how)
        told = time.monotonic()
        try:
            _, said = process.communicate(timeout=self.patience)
        except subprocess.TimeoutExpired:
            process.kill()
            _, said = process.communicate()
            self.faults.append(f"{draw}: it did not end")
        while (left := _alive(f"{number}")) and time.monotonic() - told < self.patience:
            time.sleep(0.05)
        if left:
            self.faults.append(f"{draw}: alive after {self.patience:g} s: {left}")
        if b"Traceback" in said and b"/exporter/" not in said:
            self.seen["interrupted before this program's first line, by Python itself"] += 1
        elif b"Traceback" in said or b"Exception" in said:
            self.faults.append(f"{draw}: {said.decode(errors='replace')[-800:]}")
        self._look(draw, out, temporary, killed=how is signal.SIGKILL)
        if how is signal.SIGKILL and _status(self._start(out, temporary, "numpy", "next")) != 0:
            self.faults.append(f"{draw}: the next run failed")
        self._look(f"{draw}: the next run", out, temporary, killed=False)

    def _look(self, draw: str, out: Path, temporary: Path, *, killed: bool) -> None:
        bundle = out / "continuous"
        if bundle.exists():
            Bundle.open(bundle).verify_hashes()
        left = [str(p.relative_to(self.home)) for p in (*out.glob("*"), *out.glob(".*"), *temporary.iterdir())]
        left = [name for name in left if name != "out/continuous"]
        if left and not killed:
            self.faults.append(f"{draw}: left {left}")

    def _start(self, out: Path, temporary: Path, runtimes: str, mark: str) -> subprocess.Popen[bytes]:
        command = [
            sys.executable,
            "-m",
            "export_model",
            str(fixture("continuous")),
            "-o",
            str(out),
            "--verify",
            runtimes,
        ]
        env = {**os.environ, "PYTHONPATH": PYTHONPATH, "TMPDIR": str(temporary), _MARK: mark}
        return subprocess.Popen(
            command,
            cwd=ROOT,
            env=env,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
            preexec_fn=default_signals,
        )


def _status(process: subprocess.Popen[bytes]) -> int:
    """How a run ends that is let be."""
    process.communicate(timeout=600)
    return process.returncode


def _alive(mark: str) -> list[str]:
    """The processes of a run that live, zombies apart."""
    wanted, found = f"{_MARK}={mark}".encode(), []
    for place in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has just ended
            zombie = (place / "stat").read_text().rpartition(")")[2].split()[0] == "Z"
            if not zombie and wanted in (place / "environ").read_bytes().split(b"\0"):
                found.append((place / "cmdline").read_bytes().replace(b"\0", b" ").decode()[:100])
    return found


def kill(count: int, seed: int, home: Path, patience: float) -> Kills:
    """So many kills. Raises BundleError where one tore a bundle."""
    done = Kills(home, [], Counter(), {}, patience)
    rng = random.Random(seed)
    for number in range(count):
        known = len(done.faults)
        done.one(number, rng)
        print("\n".join(done.faults[known:]), end="\n" if done.faults[known:] else "", file=sys.stderr, flush=True)
        if (number + 1) % 25 == 0:
            print(f"{number + 1} of {count}, {len(done.faults)} faults", file=sys.stderr, flush=True)
    return done


def main() -> int:
    """For ``make fuzz``."""
    count, seed = (int(text) for text in [*sys.argv[1:], *("300", "0")[len(sys.argv) - 1 :]])
    with tempfile.TemporaryDirectory() as home:
        done = kill(count, seed, Path(home), patience=5)
    for what, times in sorted(done.seen.items()):
        print(f"{what}: {times}")
    print("\n".join(done.faults) or f"{count} kills: no bundle torn, nobody alive, nothing left")
    return 1 if done.faults else 0


if __name__ == "__main__":
    sys.exit(main())
