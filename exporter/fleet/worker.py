"""One source of many, exported: in this process, or in one of several that take sources from a pipe."""

from __future__ import annotations

import signal
import sys
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType

from msgspec import Struct

from export_model.converters.files.children.child import end_with_parent
from export_model.converters.files.fetch import path_text
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.names import Claim, Claimed, Naming
from export_model.exporter.export.options import ExportOptions
from export_model.exporter.export.pipeline import Exporter, ExportResult, near
from export_model.exporter.fleet.batch import Batch
from export_model.exporter.fleet.ledger import Stamp, State, stamps, state
from export_model.exporter.fleet.outcome import Outcome, Written, one_error
from export_model.exporter.reports.entry import of_result
from export_model.signatures.cycles import raise_gc_threshold
from export_model.signatures.errors import ExportModelError, SourceError


class Wanted(Struct, frozen=True):
    """What a caller needs of each policy beside the verdict; nothing of it is kept otherwise."""

    answers: bool = False
    entries: bool = False
    #: each as soon as it is there: a failure ends the run
    at_once: bool = False


def export_source(exporter: Exporter, path: Path, names: Naming, pool: RuntimePool, wanted: Wanted) -> Outcome:
    """Export one source; with ``exporter.hold`` its bundles are staged, and in no places yet."""
    policies: list[Written] = []
    refused: list[ExportModelError] = []
    files: Mapping[str, Stamp] | None = None
    try:
        seen = state(path)
        with near(path) as here:
            jobs = exporter.compile_source(here, names, _silent, path, refused)
            files = stamps(path, (f for job in jobs for f in job.model.files))
            steps = exporter.options.parity.steps
            policies.extend(_to_written(result, wanted, steps) for result in exporter.write_jobs(jobs, pool, _silent))
    except ExportModelError as error:
        refused.append(error)
    except OSError as error:
        return Outcome(path, tuple(policies), SourceError("cannot be read", where=path_text(path), why=error.strerror))
    if refused:
        return Outcome(path, tuple(policies), one_error(refused, len(policies)))
    return Outcome(path, tuple(policies), seen=seen, files=files if _stays(path, seen) else None)


def _stays(path: Path, seen: State) -> bool:
    try:
        return state(path) == seen
    except SourceError:  # it has gone
        return False


def _to_written(result: ExportResult, wanted: Wanted, steps: int) -> Written:
    signature, report = result.policy.signature, result.report
    failures = [] if report is None else report.failures
    return Written(
        name=result.policy.name,
        folder=result.folder,
        passed=result.passed,
        what=f"{signature.family}, {signature.action_space} actions",
        renamed=result.renamed,
        failure=failures[0].sentence() if failures else None,
        undecided="" if report is None else report.undecided,
        answer=result.to_dict() if wanted.answers else None,
        entry=of_result(result, steps) if wanted.entries else None,
    )


def _silent(text: str) -> None:
    """Steps of one of many are not told."""


class _Asking(Struct, frozen=True):
    pipe: Connection

    def claim(self, path: Path, names: Sequence[str]) -> list[Claimed]:
        """As ``Names.claim``."""
        self.pipe.send(Claim(path, names))
        answer: list[Claimed] = self.pipe.recv()
        return answer


def work(pipe: Connection, options: ExportOptions, wanted: Wanted) -> None:
    """Take sources from the pipe until it says None; what they need is set up once. The program of a worker."""
    end_with_parent()
    raise_gc_threshold()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process; the first one decides
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as a terminal does that is closed
    signal.signal(signal.SIGTERM, _stop)
    if hasattr(signal, "pthread_sigmask"):  # it waited while this process was started
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    exporter = Exporter(options)
    try:
        with RuntimePool() as pool, Batch(wanted.at_once) as batch:
            exporter.hold = batch.hold
            while (path := pipe.recv()) is not None:
                pipe.send(batch.add(export_source(exporter, path, _Asking(pipe), pool, wanted)))
            pipe.send(batch.settle())
    except (EOFError, BrokenPipeError):  # nobody listens any more
        sys.exit(1)


def _stop(number: int, frame: FrameType | None) -> None:
    """Leave as an exception does, so that nothing is left behind."""
    sys.exit(128 + number)
