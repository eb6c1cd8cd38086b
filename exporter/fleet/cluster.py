"""The fleet on a Dask cluster: its workers take sources as this machine's processes do, and ask for names alike.

A source is two tasks. The first reads and compiles it until it asks for names, and returns with the question. The
second, on the same worker where it can be, hands in the names, and ends with the outcome. So no task waits for another,
and one whose worker died is run again elsewhere, by the scheduler, from the source: its names are known by then. A
bundle is put in its place in one step, and is the same bytes whoever makes it.
"""

from __future__ import annotations

import contextlib
import importlib
import re
import threading
import time
import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.files.fetch import address_of, path_text
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter import __version__
from export_model.exporter.export.labels import read_labels
from export_model.exporter.export.names import Claim, Claimed, Turns
from export_model.exporter.export.options import ExportOptions
from export_model.exporter.export.pipeline import Exporter
from export_model.exporter.fleet.outcome import Outcome
from export_model.exporter.fleet.worker import Wanted, export_source
from export_model.signatures.errors import RuntimeUnavailableError, SourceError, UsageError

#: Seconds in which a scheduler answers.
_PATIENCE = 15
#: Sources at a time for each thread of a worker: one at work, one that waits for its names.
_AHEAD = 2
#: Seconds after which a run that nothing was heard of has ended: its own process was killed.
_FORGOTTEN = 900


class Run(Struct, frozen=True):
    """What every task of a run is told."""

    identity: str
    options: ExportOptions
    wanted: Wanted


# ------------------------------------------------------------------ on a worker


class _WorkerState:
    """What a worker keeps from task to task: runtimes that have started, and sources that wait for their names."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self.exporter, self.pool = Exporter(run.options), RuntimePool()
        self.waiting: dict[Path, _Working] = {}
        #: one source at a time, however many threads the worker has
        self.lock = threading.Lock()
        self.used = time.monotonic()
        self.ended = False

    @contextlib.contextmanager
    def hold_lock(self) -> Iterator[None]:
        """A source's; a run that ended meanwhile is closed after it."""
        try:
            with self.lock:
                yield
        finally:
            self.used = time.monotonic()
            if self.ended:
                self.end()

    def end(self) -> None:
        """Close it, at once where nothing is at work here."""
        self.ended = True
        if self.lock.acquire(blocking=False):
            try:
                self._close()
            finally:
                self.lock.release()

    def _close(self) -> None:
        for working in self.waiting.values():
            working.answers.put(None)
        self.waiting.clear()
        self.pool.__exit__(None, None, None)


class _Working:
    """A source in a thread of its own, which rests while its names are not known."""

    def __init__(self, state: _WorkerState, path: Path) -> None:
        self.state, self.path = state, path
        self.said: SimpleQueue[Claim | Outcome] = SimpleQueue()
        self.answers: SimpleQueue[list[Claimed] | None] = SimpleQueue()
        threading.Thread(target=self._work, daemon=True).start()

    def claim(self, path: Path, names: Sequence[str]) -> list[Claimed]:
        """As ``Naming`` says; raises SystemExit, which ends the thread, where the run has ended."""
        self.said.put(Claim(self.path, names))
        answer = self.answers.get()
        if answer is None:
            raise SystemExit
        return answer

    def _work(self) -> None:
        state = self.state
        try:
            self.said.put(export_source(state.exporter, self.path, self, state.pool, state.run.wanted))
        except BaseException as error:
            self.said.put(
                Outcome(self.path, error=SourceError("was not exported", where=path_text(self.path), why=repr(error)))
            )
            raise


_states: dict[str, _WorkerState] = {}
_entering = threading.Lock()


def _state_of(run: Run) -> _WorkerState:
    with _entering:
        if run.identity not in _states:
            for identity, other in list(_states.items()):
                if time.monotonic() - other.used > _FORGOTTEN and not other.lock.locked():
                    _states.pop(identity).end()
            _states[run.identity] = _WorkerState(run)
        state = _states[run.identity]
        state.used = time.monotonic()
        return state


def compile_task(run: Run, path: Path) -> tuple[str, Claim | Outcome]:
    """The worker's address, and what a source asks for; or its outcome, where it came to no names."""
    from distributed import get_worker

    state = _state_of(run)
    with state.hold_lock():
        working = _Working(state, path)
        said = working.said.get()
        if isinstance(said, Claim):
            state.waiting[path] = working
        return get_worker().address, said


def finish_task(run: Run, path: Path, names: list[Claimed]) -> Outcome:
    """The outcome of a source under these names; from its beginning where it does not wait for them here."""
    state = _state_of(run)
    with state.hold_lock():
        working = state.waiting.pop(path, None)
        if working is None:
            working = _Working(state, path)
            said = working.said.get()
            if isinstance(said, Outcome):
                return said
        working.answers.put(names)
        said = working.said.get()
        assert isinstance(said, Outcome)
        return said


def shutdown(identity: str) -> None:
    """End what a worker keeps of a run."""
    with _entering:
        state = _states.pop(identity, None)
    if state is not None:
        state.end()


def program_version() -> str:
    """The version of this program on a worker."""
    return __version__


# ------------------------------------------------------------------ on the machine that asks


class Cluster(Struct):
    """Sources spread over a cluster's workers: an executor of a fleet, as its own processes are."""

    address: str
    options: ExportOptions
    wanted: Wanted
    #: of the sources' first tasks, by the workers that they were on
    turns: Turns[str]
    paths: Sequence[Path]

    def run(self) -> Iterator[Outcome]:
        """What becomes of the sources, as it comes. Raises RuntimeUnavailableError."""
        client = _connect(self.address)
        run = Run(uuid.uuid4().hex, _anywhere(self.options), self.wanted)
        try:
            yield from self._outcomes(client, run)
        finally:
            # One that is lost is asked for nothing: an answer would be waited for.
            with contextlib.suppress(OSError, CancelledError):
                if client.status == "running":
                    client.run(shutdown, run.identity, on_error="ignore")
            client.close()

    def _outcomes(self, client: Any, run: Run) -> Iterator[Outcome]:
        index: dict[Any, int] = {}
        done = _dask(self.address).as_completed(loop=client.loop)
        todo = iter(range(len(self.paths)))

        def submit(number: int, function: Any, *given: Any, **where: Any) -> None:
            # A source's place is its priority: names are given in that order.
            if client.status != "running":
                raise self._lost_error()
            future = client.submit(
                function, run, _absolute(self.paths[number]), *given, pure=False, priority=-number, **where
            )
            index[future.key] = number
            done.add(future)

        for _, number in zip(range(_AHEAD * sum(client.nthreads().values())), todo, strict=False):
            submit(number, compile_task)
        for future in done:
            number = index.pop(future.key)
            worker, said = self._result_of(future, number)
            if isinstance(said, Claim):
                self.turns.asks(number, worker, replace(said, path=self.paths[number]))
            else:
                self.turns.ends(number)
                if (following := next(todo, None)) is not None:
                    submit(following, compile_task)
                yield replace(said, path=self.paths[number])
            for named, where, names in self.turns.answers():
                submit(named, finish_task, names, workers=[where], allow_other_workers=True)

    def _result_of(self, future: Any, number: int) -> tuple[str, Claim | Outcome]:
        try:
            error = None if future.cancelled() else future.exception()
            if error is None:
                result = future.result()
                future.release()
                return result if isinstance(result, tuple) else ("", result)
        except (CancelledError, OSError) as gone:
            raise self._lost_error() from gone
        path = self.paths[number]
        failed = SourceError(
            "was not exported by the cluster",
            where=path_text(path),
            why=f"{type(error).__name__}: {error}",
            fix="export it alone to see more; if memory ran out, give the workers more",
        )
        return "", Outcome(path, error=failed)

    def _lost_error(self) -> RuntimeUnavailableError:
        return RuntimeUnavailableError(
            f"the cluster at {self.address} was lost",
            why="its scheduler ended or was restarted",
            fix="call again: what was exported is left out",
        )


def _dask(address: str) -> Any:
    try:
        return importlib.import_module("distributed")
    except ImportError as error:
        raise RuntimeUnavailableError(
            f"--cluster {address} needs Dask", why=str(error), fix="pip install 'export-model[cluster]'"
        ) from error


def _connect(address: str) -> Any:
    if re.search(r":\d{1,5}/?$", address) is None:  # Dask would look for it for half a minute
        raise UsageError(f"--cluster {address}: must be an address with a port", fix="--cluster tcp://HOST:8786")
    try:
        client = _dask(address).Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:  # the last where tls:// lacks its settings
        raise RuntimeUnavailableError(
            f"no scheduler answers at {address}",
            why=str(error),
            fix="start one: dask scheduler; for tls:// give Dask its keys: distributed.comm.tls",
        ) from error
    # A worker without this program gives an error for its version.
    found = client.run(program_version, on_error="return") if client.nthreads() else {}
    why = next((f"on {w} export-model is {v}, here {__version__}" for w, v in found.items() if v != __version__), None)
    if why is None and found:
        return client
    client.close()
    raise RuntimeUnavailableError(
        f"the cluster at {address} cannot be used",
        why=why or "it has no workers",
        fix="start workers where this version of export-model is installed: dask worker ADDRESS --nthreads 1",
    )


def _anywhere(options: ExportOptions) -> ExportOptions:
    """Options that say the same in another folder."""
    golden = options.parity.golden
    parity = options.parity if golden is None else replace(options.parity, golden=Path(golden).absolute())
    return replace(options, out=_absolute(options.out), labels=read_labels(options.labels), parity=parity)


def _absolute(path: Path) -> Path:
    return path if address_of(path) is not None else path.absolute()
