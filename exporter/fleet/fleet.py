"""Export many sources, with as many processes as are asked for; results come as they are made, and none is kept.

What is written does not depend on the number of processes: a policy's name is the only thing that depends on the other
sources, and names are given in the order of the sources.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from multiprocessing.resource_tracker import ensure_running
from pathlib import Path
from typing import Any

from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.files.fetch import path_text
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.names import Claim, Names, Turns
from export_model.exporter.export.options import ExportOptions
from export_model.exporter.export.pipeline import Exporter
from export_model.exporter.fleet.batch import Batch
from export_model.exporter.fleet.ledger import Ledger
from export_model.exporter.fleet.outcome import Outcome
from export_model.exporter.fleet.worker import Wanted, export_source, work
from export_model.signatures.errors import SourceError, UsageError

#: How long a worker may take to clean up when it is told to end.
_GRACE_SECONDS = 10.0
_SAFE_PATH = "PYTHONSAFEPATH"


def export_fleet(
    paths: Sequence[Path],
    options: ExportOptions,
    *,
    jobs: int = 1,
    again: bool = False,
    fail_fast: bool = False,
    cluster: str | None = None,
    wanted: Wanted | None = None,
) -> Iterator[Outcome]:
    """Export every source, ``jobs`` at a time, or by the workers of the Dask cluster at ``cluster``.

    What ended last comes last. A source that was exported to the same folder with the same options, and is unchanged,
    is left out unless ``again`` is set. ``fail_fast`` ends with the first source that is refused or disagrees. Raises
    UsageError, RuntimeUnavailableError before the first source is read; what becomes of a source is in its Outcome.
    """
    if jobs < 1:
        raise UsageError(f"--jobs {jobs}: must be 1 or more", fix="leave it out: one at a time")
    if options.name is not None and len(paths) > 1:
        raise UsageError("--name goes with a single policy", fix="export one source, or leave --name out")
    wanted = replace(wanted or Wanted(), at_once=fail_fast)
    exporter, names = Exporter(options), Names()
    exporter.check(paths, lambda text: None)
    ledger = Ledger(options, exporter.runtimes)
    waiting = []
    for path in paths:
        done = None if again else ledger.unchanged_policies(path)
        if done is None:
            waiting.append(path)
            continue
        for name in done:
            names.reserve(path, name)
        yield Outcome(path, unchanged=True)
    if cluster is not None:
        from export_model.exporter.fleet.cluster import Cluster

        made = Cluster(cluster, options, wanted, Turns(names), waiting).run()
    elif jobs == 1 or len(waiting) < 2:
        made = _here(exporter, waiting, names, wanted)
    else:
        made = _Crew(options, wanted, Turns(names), waiting).run(min(jobs, len(waiting)))
    for outcome in made:
        if not outcome.failed and outcome.files is not None:
            ledger.record(outcome.path, outcome.seen, outcome.files, [p.name for p in outcome.policies])
        yield outcome
        if fail_fast and outcome.failed:
            return


def _here(exporter: Exporter, paths: Sequence[Path], names: Names, wanted: Wanted) -> Iterator[Outcome]:
    with RuntimePool() as pool, Batch(wanted.at_once) as batch:
        exporter.hold = batch.hold
        for path in paths:
            yield from batch.add(export_source(exporter, path, names, pool, wanted))
        yield from batch.settle()


@contextmanager
def _no_modules_of_this_folder() -> Iterator[None]:
    """What multiprocessing starts is ``python -c``, which looks first where the user stands: which may be untrusted."""
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_SAFE_PATH]
        else:
            os.environ[_SAFE_PATH] = before


@contextmanager
def _interrupts_wait() -> Iterator[None]:
    """A process that is started inside is not interrupted before it says what an interrupt is to it (``worker.work``).

    Ctrl-C goes to every process of a terminal; one that still imports its modules would end in a traceback.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    ensure_running()  # else the first start does it, and unblocks what is blocked here (CPython's resource_tracker.py)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Worker(Struct):
    process: BaseProcess
    pipe: Connection
    #: which source it is at; None where it has been told to end
    at: int | None
    #: the sources that it is done with, but for their bundles' way to their places
    staged: list[int] = field(default_factory=list)


class _Crew(Struct):
    options: ExportOptions
    wanted: Wanted
    turns: Turns[_Worker]
    paths: Sequence[Path]
    todo: deque[int] = field(default_factory=deque)
    workers: list[_Worker] = field(default_factory=list)
    #: workers that have nothing left to do, and end
    ending: list[_Worker] = field(default_factory=list)
    #: sources that were lost with a process that died at another
    lost: set[int] = field(default_factory=set)

    def run(self, count: int) -> Iterator[Outcome]:
        """What becomes of the sources, as it comes."""
        self.todo.extend(range(len(self.paths)))
        with self:
            for _ in range(count):
                self._start()
            while self.workers:
                for ready in wait([w.pipe for w in self.workers]):
                    worker = next(w for w in self.workers if w.pipe is ready)
                    outcomes = self._receive(worker)
                    if outcomes is None:
                        continue
                    if worker.at is not None:
                        self.turns.ends(worker.at)
                        self._give_names()
                    self._next(worker)
                    yield from outcomes

    def _receive(self, worker: _Worker) -> list[Outcome] | None:
        """What a worker says: the outcomes that are certain, or None where it asked for names."""
        try:
            message: Any = worker.pipe.recv()
        except (EOFError, OSError):
            worker.process.join()
            return self._after_death(worker)
        if isinstance(message, Claim):
            assert worker.at is not None
            self.turns.asks(worker.at, worker, message)
            self._give_names()
            return None
        if worker.at is not None:
            worker.staged.append(worker.at)
        for outcome in message:
            worker.staged.remove(next(n for n in worker.staged if self.paths[n] == outcome.path))
        return list(message)

    def _after_death(self, worker: _Worker) -> list[Outcome]:
        """The outcomes of sources whose process died at them; what was only staged is exported again, once."""
        died = [n for n in worker.staged if n in self.lost] + ([] if worker.at is None else [worker.at])
        again = [n for n in worker.staged if n not in self.lost]
        self.lost.update(again)
        self.todo.extendleft(reversed(again))
        return [
            Outcome(
                self.paths[number],
                error=SourceError(
                    "the process that exported it ended",
                    where=path_text(self.paths[number]),
                    why=f"its status is {worker.process.exitcode}",
                    fix="export it alone to see more; if memory ran out, use fewer --jobs",
                ),
            )
            for number in died
        ]

    def _give_names(self) -> None:
        for _, worker, names in self.turns.answers():
            self._send(worker, names)

    def _next(self, worker: _Worker) -> None:
        if not worker.process.is_alive():
            worker.pipe.close()
            self.workers.remove(worker)
            if self.todo:
                self._start()
        elif self.todo:
            worker.at = self.todo.popleft()
            self._send(worker, self.paths[worker.at])
        elif worker.at is not None:  # what it has staged comes last
            worker.at = None
            self._send(worker, None)
        else:
            self.workers.remove(worker)
            self.ending.append(worker)

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=work, args=(theirs, self.options, self.wanted), daemon=False)
        with _no_modules_of_this_folder(), _interrupts_wait():
            process.start()
        theirs.close()
        number = self.todo.popleft()
        worker = _Worker(process, ours, number)
        self.workers.append(worker)
        self._send(worker, self.paths[number])

    @staticmethod
    def _send(worker: _Worker, message: Any) -> None:
        try:
            worker.pipe.send(message)
        except OSError:  # it has ended, which the next wait tells
            return

    def __enter__(self) -> _Crew:
        return self

    def __exit__(self, *error: object) -> None:
        for worker in self.workers:
            worker.process.terminate()
        for worker in (*self.workers, *self.ending):
            worker.process.join(_GRACE_SECONDS)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()
            worker.pipe.close()
        self.workers.clear()
        self.ending.clear()
