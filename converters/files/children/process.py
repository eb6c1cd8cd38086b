"""A runtime's process, seen from this side."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import numpy as np

from export_model.converters.files.children.confinement import in_force
from export_model.converters.files.children.environment import child_environment, readable_places
from export_model.converters.files.children.frames import (
    MAX_TENSOR_BYTES,
    FramingError,
    Tensors,
    read_frame,
    write_frame,
)
from export_model.converters.files.children.memory_limits import ChildMemory
from export_model.converters.files.children.python import confined_command
from export_model.converters.files.children.time_limits import processor_time, time_limit
from export_model.converters.files.folders import OwnFolder, link_model, live_folders, scratch_folder, size_of
from export_model.signatures.errors import ExportModelError, RuntimeUnavailableError

#: Seconds that one request may take: importing TensorFlow on a loaded machine is the slowest of them.
TIMEOUT = 300.0
#: Seconds after which it is looked at again whether one has taken too long.
_LOOK = 1.0

#: The most bytes of an answer of a program that anyone may have made.
_MAX_FOREIGN_BYTES = 1 << 28
#: In the place of what a program said that anyone may have made.
_UNSAID = "what it said is not repeated (-v prints it)"
#: Where in its folder a process writes; beside it lies what it is handed, to be read alone.
_WRITES = "own"
#: Bytes that several runs are fed in one request: answers are held until the last of them, and one that takes longer
#: than ``TIMEOUT`` is taken for dead.
_REQUEST = 4 << 20


class RunFailedError(ExportModelError):
    """A runtime refused a model or failed while running it. This is what verification reports, not a crash of it."""

    __module__ = "export_model"
    exit_status = 1
    #: The words of a program that anyone may have made, for who asks for them: no message repeats them.
    said = ""


class RuntimeProcess(AbstractContextManager["RuntimeProcess"]):
    """A child process that speaks frames. Started on first use, fed many models, ended by ``close``."""

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        *,
        confined: bool = True,
        browser: bool = False,
        own_words: str | None = None,
        timed_out: set[str] | None = None,
    ) -> None:
        """A process that is not started yet.

        ``confined``: it may not read or write outside of its places, nor reach a network (confinement.py); else it
        gives that up by itself, or is a ``browser`` and gives up nothing.

        ``own_words``: it runs source code, and of what is said then only what this pattern matches is repeated.

        ``timed_out``: files that this or another runtime was stopped with, which are not loaded again; one that has no
        end before its first answer is added. None where the models are trusted, or slow by themselves (Keras).
        """
        self.name = name
        self.command = list(command)
        self.confined, self.browser = confined, browser
        self._own_words = own_words
        self.version: str | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._errors: IO[bytes] | None = None
        self._scratch: OwnFolder | None = None
        #: folders that it can read, of those that this process has; None where it reads all that the user can
        self._open: tuple[Path, ...] | None = None
        #: it has been asked and has not answered
        self._busy = False
        #: when it was asked
        self._asked = 0.0
        self._closed = threading.Event()
        self._memory: ChildMemory | None = None
        #: models to free, by identity and bytes, as soon as the request that is under way is answered
        self._to_free: list[tuple[str, int]] = []
        self._loaded = 0
        self._timed_out = timed_out
        #: the model that has not answered yet, the processor time at which the process is stopped, how much that gives
        self._first: tuple[str, float, float] | None = None

    def launch(self) -> None:
        """Start the process if it is not running, and do not wait for it: it gets ready beside what is done next.

        Raises RuntimeUnavailableError where there is no such program.
        """
        if self._process is not None:
            return
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  it lives as long as the process
        self._scratch = scratch_folder()
        own = self._scratch.path / _WRITES
        own.mkdir()
        # A browser has its own folders where the user's are, and sweeps them by itself.
        self._open = None if self.browser or not in_force()["reading"] else live_folders()
        readable = () if self._open is None else (*readable_places(self.command), *map(str, self._open))
        try:
            self._process = subprocess.Popen(
                confined_command(self.command, str(own)) if self.confined else self.command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                env=child_environment(None if self.browser else own, readable),
                start_new_session=True,  # no terminal is its own, to read from or to type into
            )
        except OSError as error:
            self.close()
            raise RuntimeUnavailableError(
                f"the runtime {self.name} did not start", why=str(error), fix="export-model runtimes shows what is here"
            ) from error
        self._closed = threading.Event()
        threading.Thread(target=self._watch, args=(self._process, self._closed), daemon=True).start()
        # Sent ahead: some runtimes start with the first request. One that ends at once is noticed by ``start``.
        with contextlib.suppress(BrokenPipeError):
            write_frame(self._streams[0], {"cmd": "hello"})

    def start(self) -> str:
        """Start the process if it is not running, and wait until it is ready; returns the runtime's version.

        Raises RuntimeUnavailableError when it does not start.
        """
        if self.version is not None:
            return self.version
        self.launch()
        try:
            answer, _ = self._exchange(None)
        except RunFailedError as error:
            self.close()  # its one "hello" is answered: asked again, it would be silent
            raise RuntimeUnavailableError(
                f"the runtime {self.name} did not start",
                why=error.why or error.what,
                fix="export-model runtimes shows what is here and how to install what is not",
            ) from error
        self.version = str(answer["version"])
        if self._process is not None and self.confined:
            self._memory = ChildMemory(self._process.pid)
        return self.version

    def load(self, path: str, *, answered: bool = False, **options: Any) -> LoadedModel:
        """Load a model; raises RunFailedError with the runtime's own message, or where it computes for ever.

        ``answered``: it did so once, and has the time of any request.
        """
        self.start()
        if path in (self._timed_out or ()):
            raise RunFailedError(f"not run in {self.name}", why="a runtime was stopped while it computed this file")
        self._loaded += 1
        identity = f"m{self._loaded}"
        size, memory = size_of(Path(path)), self._memory
        if memory is not None:
            memory.allow(size)
        try:
            with contextlib.nullcontext() if answered else self.first(path, size):
                self.request({"cmd": "load", "id": identity, "path": self._hand_over(path, identity), **options})
        except RunFailedError:
            self._take_back(identity, size)
            raise
        return LoadedModel(self, identity, size, path, answered=answered)

    def _hand_over(self, path: str, identity: str) -> str:
        """A path by which the process can read a model, and what lies beside that under its name."""
        place = Path(path).absolute()
        if self._open is None or self._scratch is None or not place.exists():
            return path
        if any(place.resolve().is_relative_to(folder.resolve()) for folder in self._open):
            return path
        return str(link_model(place, self._scratch.path / identity))

    def _take_back(self, identity: str, size: int) -> None:
        if self._memory is not None:
            self._memory.release(size)
        if self._scratch is not None:
            shutil.rmtree(self._scratch.path / identity, ignore_errors=True)

    @contextlib.contextmanager
    def first(self, path: str, size: int) -> Iterator[None]:
        """What is asked inside has little processor time (time_limits.py): a model is loaded, or answers once."""
        process = self._process
        before = None if process is None or self._timed_out is None else processor_time(process.pid)
        self._first = None if before is None else (path, before + time_limit(size), time_limit(size))
        try:
            yield
        finally:
            self._first = None

    def unload(self, identity: str, size: int) -> None:
        """Free a model of that many bytes; with the next request, where one is under way.

        What holds a model may be collected at any moment, in the middle of reading another model's answer, too.
        """
        if self._busy:
            self._to_free.append((identity, size))
            return
        self._free(identity, size)

    def _free(self, identity: str, size: int) -> None:
        self._exchange(lambda stream: write_frame(stream, {"cmd": "unload", "id": identity}))
        self._take_back(identity, size)

    def request(
        self, header: Mapping[str, Any], tensors: Mapping[str, np.ndarray] | None = None
    ) -> tuple[dict[str, Any], Tensors]:
        """Send a frame and wait for the answer.

        Raises RunFailedError where the answer is an error, the process died, or hangs.
        """
        while self._to_free:
            self._free(*self._to_free.pop())
        if self._memory is not None:
            self._memory.allow_for_request(sum(a.nbytes for a in (tensors or {}).values()))
        return self._exchange(lambda stream: write_frame(stream, header, tensors))

    @property
    def _streams(self) -> tuple[BinaryIO, BinaryIO]:
        process = self._process
        if process is None or process.stdin is None or process.stdout is None:
            raise RunFailedError(f"{self.name} is not running")
        return cast(BinaryIO, process.stdin), cast(BinaryIO, process.stdout)

    def _exchange(self, send: Callable[[BinaryIO], None] | None) -> tuple[dict[str, Any], Tensors]:
        """Send a frame, unless it was sent ahead, and wait for an answer."""
        to, back = self._streams
        process = self._process
        assert process is not None
        try:
            self._asked, self._busy = time.monotonic(), True
            if send is not None:
                send(to)
            answer, results = read_frame(back, MAX_TENSOR_BYTES if self._own_words is None else _MAX_FOREIGN_BYTES)
            self._busy = False
        except (OSError, EOFError, FramingError) as error:
            status = _wait_or_kill(process)
            said = self._last_errors()
            self.close()
            if self._first is not None and self._first[0] in (self._timed_out or ()):
                raise RunFailedError(
                    f"{self.name} was stopped: it did not come to an end",
                    why=f"to load this file, or answer its first input, {self._first[2]:.0f} s of computing are enough",
                    fix="the file may loop for ever; no other runtime is given it",
                ) from error
            raise self._failure(
                f"{self.name} ended while it was working (status {status})",
                said or (str(error) if isinstance(error, FramingError) else "it printed nothing"),
                "a native runtime aborts on some malformed graphs; the model is not safe to use there",
            ) from error
        if answer.get("broken"):  # a WebAssembly trap: the heap is not to be trusted any more
            self.close()
        if not answer.get("ok"):
            raise self._failure(f"{self.name} failed", str(answer.get("error", "no message")))
        return answer, results

    def _failure(self, what: str, said: str, fix: str | None = None) -> RunFailedError:
        """What went wrong, in the runtime's words; a program's own are kept apart (``own_words``)."""
        if self._own_words is None or not self._loaded:
            return RunFailedError(what, why=said, fix=fix)
        known = re.match(self._own_words, said)
        error = RunFailedError(what, why=_UNSAID if known is None else known.group(), fix=fix)
        error.said = "\n".join(dict.fromkeys((said, self._last_errors())))
        return error

    def _watch(self, process: subprocess.Popen[bytes], closed: threading.Event) -> None:
        """End a process whose answer takes too long. One thread for all requests: there are dozens for each policy."""
        while not closed.wait(min(_LOOK, TIMEOUT)):
            if not self._busy:
                continue
            first, timed_out = self._first, self._timed_out
            if first is not None and timed_out is not None and (processor_time(process.pid) or 0) > first[1]:
                timed_out.add(first[0])
                _end(process, kill=True)
                return
            if time.monotonic() - self._asked > TIMEOUT:
                _end(process, kill=True)
                return

    def _last_errors(self) -> str:
        if self._errors is None:
            return ""
        self._errors.seek(0)
        lines = self._errors.read().decode("utf-8", "replace").strip().splitlines()
        return "\n".join(lines[-8:])

    def hang_up(self) -> None:
        """Tell the process to end, and do not wait: several end side by side before each is closed."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.close()

    def close(self) -> None:
        """End the process; one that is not ready yet, or computes (an interrupt came), is not waited for."""
        self.hang_up()
        self._closed.set()
        process, ready = self._process, self.version is not None and not self._busy
        self._process, self.version, self._busy, self._to_free = None, None, False, []
        if process is not None:
            if not ready:
                _end(process, kill=False)  # one that has started a browser ends that first
            if process.stdout is not None:
                process.stdout.close()
            _wait_or_kill(process, 60 if self.browser else 10)
        if self._errors is not None:
            self._errors.close()
            self._errors = None
        if self._scratch is not None:
            self._scratch.close()
            self._scratch = None
        self._memory = None

    def __exit__(self, *error: object) -> None:
        self.close()


def _requests(inputs: Sequence[Mapping[str, np.ndarray]], *, alone: bool) -> Iterator[tuple[int, int]]:
    """From where to where ``inputs`` go into one request: as many as ``_REQUEST`` bytes hold, one at least.

    ``alone``: the first of them goes by itself.
    """
    first = size = 0
    for number, feeds in enumerate(inputs):
        size += sum(array.nbytes for array in feeds.values())
        if (size > _REQUEST and number > first) or (alone and number == 1):
            yield first, number
            first, size = number, sum(array.nbytes for array in feeds.values())
    if inputs:
        yield first, len(inputs)


def _wait_or_kill(process: subprocess.Popen[bytes], patience: float = 5) -> int:
    """The status of a process that should be ending; one that lives on after ``patience`` seconds is killed."""
    try:
        return process.wait(patience)
    except subprocess.TimeoutExpired:  # it closed its stdout, or speaks no frames any more
        _end(process, kill=True)
        return process.wait()


def _end(process: subprocess.Popen[bytes], *, kill: bool) -> None:
    """Tell a process, and what it has started, to end; ``kill``: it is not asked. No terminal's signal reaches them."""
    if sys.platform == "win32":
        process.terminate()
    elif process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL if kill else signal.SIGTERM)


class LoadedModel(AbstractContextManager["LoadedModel"]):
    """A model in a runtime's process."""

    def __init__(self, process: RuntimeProcess, identity: str, size: int, path: str, *, answered: bool) -> None:
        self._process, self._identity, self._size, self._path = process, identity, size, path
        self._answered = answered

    def run(self, feeds: Mapping[str, np.ndarray], fetch: Sequence[str], **request: Any) -> Tensors:
        """The outputs in ``fetch`` by name; raises RunFailedError. ``request`` is for what one runtime alone can do."""
        return self._run({"fetch": list(fetch), **request}, feeds, fetch)

    def run_all(
        self,
        inputs: Sequence[Mapping[str, np.ndarray]],
        fetch: Sequence[str],
        requests: Sequence[Mapping[str, Any]] = (),
    ) -> list[Tensors]:
        """The same outputs for several inputs, in few requests; ``requests``: for each what ``run`` takes besides."""
        wanted = {"fetch": list(fetch)}
        headers = [{**wanted, **request} for request in requests] or [wanted] * len(inputs)
        return self._run_all(inputs, headers, fetch)

    def predict(self, feeds: Mapping[str, np.ndarray], outputs: Sequence[str]) -> Tensors:
        """All outputs, by the call that users of the runtime make (TensorFlow.js: ``model.predict``)."""
        return self._run({}, feeds, outputs)

    def predict_all(self, inputs: Sequence[Mapping[str, np.ndarray]], outputs: Sequence[str]) -> list[Tensors]:
        """As ``predict``, for several inputs."""
        return self._run_all(inputs, [{}] * len(inputs), outputs)

    def _run(self, header: Mapping[str, Any], feeds: Mapping[str, np.ndarray], fetch: Sequence[str]) -> Tensors:
        _, results = self._request({"cmd": "run", "id": self._identity, **header}, dict(feeds))
        return self._require_outputs(results, fetch)

    def _request(self, header: Mapping[str, Any], tensors: Tensors) -> tuple[dict[str, Any], Tensors]:
        if self._answered:
            return self._process.request(header, tensors)
        with self._process.first(self._path, self._size):
            answer = self._process.request(header, tensors)
        self._answered = True
        return answer

    def _run_all(
        self, inputs: Sequence[Mapping[str, np.ndarray]], headers: Sequence[Mapping[str, Any]], fetch: Sequence[str]
    ) -> list[Tensors]:
        found: list[Tensors] = []
        for first, last in _requests(inputs, alone=not self._answered):
            keys: dict[int, str] = {}  # what several runs are fed is sent once
            tensors: Tensors = {}
            runs = []
            for feeds, header in zip(inputs[first:last], headers[first:last], strict=True):
                for array in feeds.values():
                    tensors[keys.setdefault(id(array), str(len(keys)))] = array
                runs.append({**header, "feeds": {name: keys[id(array)] for name, array in feeds.items()}})
            _, results = self._request({"cmd": "runs", "id": self._identity, "runs": runs}, tensors)
            answers: list[Tensors] = [{} for _ in runs]
            for number, answer in enumerate(answers):
                answer |= {name: results[key] for name in fetch if (key := f"{number}/{name}") in results}
            found += [self._require_outputs(each, fetch) for each in answers]
        return found

    def _require_outputs(self, results: Tensors, fetch: Sequence[str]) -> Tensors:
        missing = [name for name in fetch if name not in results]
        if missing:
            raise RunFailedError(f"{self._process.name} gave no output {missing[0]!r}")
        return results

    def unload(self) -> None:
        """Free it; a runtime that has died has freed it already."""
        with contextlib.suppress(RunFailedError):
            self._process.unload(self._identity, self._size)

    def __exit__(self, *error: object) -> None:
        self.unload()
