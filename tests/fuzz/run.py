"""Mutants by number, in processes that are started anew where one dies or hangs; what came of them, counted."""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.commands import PYTHONPATH

#: Seconds that a mutant may take on the clock of a busy machine; what it computes is limited to far less.
HANG = 300.0
GOOD = ("ok", "refused")
_ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Result:
    """What came of the mutants of one reader: how often what, and each failure by its number."""

    reader: str
    counts: Counter[str] = field(default_factory=Counter)
    failures: list[tuple[int, dict[str, Any]]] = field(default_factory=list)
    slowest: float = 0.0

    def add(self, number: int, outcome: dict[str, Any]) -> None:
        """Count an outcome."""
        self.counts[outcome["kind"]] += 1
        self.slowest = max(self.slowest, outcome.get("seconds", 0.0))
        if outcome["kind"] not in GOOD:
            self.failures.append((number, outcome))

    def grouped(self) -> list[tuple[int, str, int]]:
        """(how often, what and where, the first mutant), the frequent first."""
        groups: dict[tuple[str, str], list[int]] = {}
        said: dict[tuple[str, str], str] = {}
        for number, outcome in self.failures:
            key = (outcome["kind"], outcome.get("place", ""))
            groups.setdefault(key, []).append(number)
            said.setdefault(key, outcome.get("said", ""))
        lines = [(len(n), f"{k[0]} at {k[1]}: {said[k]}", n[0]) for k, n in groups.items()]
        return sorted(lines, reverse=True)


class _Worker:
    """One process; it is given ranges of numbers, and ended where it does not answer."""

    def __init__(self, readers: Sequence[str]) -> None:
        environment = os.environ | {"PYTHONPATH": PYTHONPATH, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.worker", *readers],
            cwd=_ROOT, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        self._waiting = b""
        self._selector = selectors.DefaultSelector()
        assert self._process.stdout is not None
        self._selector.register(self._process.stdout, selectors.EVENT_READ)
        if self.line(10 * HANG) != "ready":
            raise RuntimeError(self.end())

    def give(self, first: int, last: int) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{first} {last}\n".encode())
        self._process.stdin.flush()

    def line(self, seconds: float = HANG) -> str | None:
        """The next line; None where there is none in time, or the process is gone."""
        assert self._process.stdout is not None
        while b"\n" not in self._waiting:
            if not self._selector.select(seconds):
                return None
            data = os.read(self._process.stdout.fileno(), 1 << 16)
            if not data:
                return ""
            self._waiting += data
        line, self._waiting = self._waiting.split(b"\n", 1)
        return line.decode()

    def end(self) -> str:
        """End it; what it said last on its error output."""
        if self._process.poll() is None:
            self._process.kill()
        _, said = self._process.communicate()
        self._selector.close()
        return f"status {self._process.returncode} {said.decode(errors='replace').strip()[-300:]}"


def run(readers: Sequence[str], first: int, count: int) -> Result:
    """The mutants ``first`` to ``first + count`` of a reader; several readers take turns, with ``count`` for all."""
    result = Result(", ".join(readers))
    at, last = first, first + count
    while at < last:
        worker = _Worker(readers)
        worker.give(at, last)
        while at < last:
            line = worker.line()
            if line and line.startswith(">"):
                continue
            if not line:
                said = worker.end()
                result.add(at, {"kind": "hang" if line is None else "death", "said": said, "place": ""})
                at += 1
                break
            result.add(at, outcome := json.loads(line))
            at += 1
            if (
                outcome["kind"] == "memory"
            ):  # what a process once took, it would be found to take with each that follows
                break
        worker.end()
    return result
