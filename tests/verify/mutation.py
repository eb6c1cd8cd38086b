"""Runs mutants in forks of one process that has collected the tests: a fork breaks the function in place.

Which tests reach which line is measured once for each state of the code and kept in the system's temporary folder.
What runs at import (a constant, a default) is broken in a process of its own that imports the module with its break.
"""

from __future__ import annotations

import gc
import hashlib
import importlib.abc
import importlib.util
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import coverage
import pytest
from _pytest.runner import runtestprotocol

from tests.verify.mutants import ROOMS, ROOT, Mutant, broken, mutants

#: Tests that may reach the judge, and start no runtime but those of the last.
TESTS = ("tests/verify", "tests/exporter", "tests/reports", "tests/compare")
#: Those that start nothing at all, and hardly any command: a mutant takes a second.
QUICK = (
    *("tests/verify", "tests/exporter/test_comparison.py", "tests/exporter/test_bisection.py"),
    *("tests/compare/test_pairing.py", "tests/compare/test_handmade.py"),
)
#: Of a module, in the map: every test that runs a line of it.
_ANY = "any"
#: Where it is kept, by what it hangs on.
KEPT = Path(tempfile.gettempdir()) / "mutants-map"
_WORKERS = 2
#: A mutant that takes so many times what its tests took, and so many seconds more, never ends.
_PATIENCE, _SECONDS = 4, 4
_MUTANT = "EXPORT_MODEL_MUTANT"

Map = dict[str, dict[str, list[str]]]
#: (module, qualified name) → the functions of that name.
Functions = dict[tuple[str, str], list[FunctionType]]


def survivors(chosen: Sequence[Mutant], tests: Sequence[str] = TESTS) -> Iterator[tuple[Mutant, str]]:
    """Those that no test of these files kills, and why."""
    runner = Runner(chosen)
    status = pytest.main([*_arguments(), *tests], plugins=[runner])
    if not runner.done:
        raise SystemExit(f"the tests were not run: {status}")
    yield from sorted(runner.alive, key=lambda each: each[0].number)


def _arguments() -> list[str]:
    return ["-q", "-x", "-p", "no:cacheprovider"]


class Runner:
    """A plugin of pytest that takes the place of its loop."""

    def __init__(self, chosen: Sequence[Mutant]) -> None:
        self.chosen, self.done = chosen, False
        self.alive: list[tuple[Mutant, str]] = []
        self.folder = Path(tempfile.mkdtemp(prefix="mutants-"))

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Leave out what starts more than an onnxruntime."""
        markers = ("corpus", "slow", "peers", "legacy", "browser")
        items[:] = [
            item
            for item in items
            if not any(item.get_closest_marker(m) for m in markers)
            and ("tests/compare" in item.nodeid or not item.get_closest_marker("runtimes"))
        ]

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        items = {item.nodeid: item for item in session.items}
        order = {nodeid: i for i, nodeid in enumerate(items)}
        lines, seconds = self._map(session)
        functions: Functions = defaultdict(list)
        for each in gc.get_objects():
            if isinstance(each, FunctionType):
                functions[each.__module__, each.__qualname__].append(each)
        gc.collect()
        gc.freeze()
        print(f"\n{len(self.chosen)} mutants, {len(seconds)} tests", flush=True)
        running: dict[int, tuple[Mutant, Path]] = {}
        for mutant in self.chosen:
            reached = lines.get(mutant.file, {}).get(str(mutant.line) if mutant.function else _ANY, [])
            tests = _by_cost([t for t in reached if t in items], seconds, order)
            if not tests:
                self.alive.append((mutant, "no test reaches it"))
                continue
            if len(running) == _WORKERS:
                self._wait(running)
            limit = _SECONDS + _PATIENCE * sum(seconds[t] for t in tests)
            own = self.folder / str(mutant.number)
            found = functions[mutant.module, mutant.function]
            running[_fork(mutant, found, [items[t] for t in tests], limit, own)] = mutant, own
        while running:
            self._wait(running)
        shutil.rmtree(self.folder, ignore_errors=True)
        self.done = True
        return True

    def _wait(self, running: dict[int, tuple[Mutant, Path]]) -> None:
        child, status = os.wait()
        mutant, own = running.pop(child)
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # what its tests have started
        shutil.rmtree(own, ignore_errors=True)
        if status == 0:
            self.alive.append((mutant, "all pass"))
        print(f" {mutant.number} survives " if status == 0 else ".", end="", flush=True)

    def _map(self, session: pytest.Session) -> tuple[Map, dict[str, float]]:
        """Which tests run which line, and how long each takes that passes."""
        groups: dict[Path, list[pytest.Item]] = defaultdict(list)
        for item in session.items:
            groups[item.path].append(item)
        kept = {file: KEPT / f"{_state(file)}.json" for file in groups}
        KEPT.mkdir(exist_ok=True)
        shares: list[list[Path]] = [[] for _ in range(_WORKERS)]
        for file in (f for f in groups if not kept[f].exists()):
            min(shares, key=lambda share: sum(len(groups[f]) for f in share)).append(file)
        children = [
            _fork_map({kept[f]: groups[f] for f in share}, self.folder / f"map{i}")
            for i, share in enumerate(shares)
            if share
        ]
        ended = [os.waitpid(child, 0)[1] for child in children]
        if any(ended):
            raise SystemExit("the tests were not measured")
        lines: Map = defaultdict(lambda: defaultdict(list))
        seconds: dict[str, float] = {}
        for found in (json.loads(file.read_text()) for file in kept.values()):
            seconds |= found["seconds"]
            for file, by_line in found["lines"].items():
                for line, tests in by_line.items():
                    lines[file][line] += tests
        return lines, seconds


def _state(file: Path) -> str:
    """What a file's map hangs on: the code of both rooms, what tests share, and the file."""
    shared = [path for folder in TESTS for path in (ROOT / folder).rglob("*.py")]
    shared = [path for path in shared if not path.name.startswith(("test_", "mut"))]
    code = [path for room in ROOMS for path in (ROOT / room).rglob("*.py")]
    made = hashlib.sha256()
    for path in sorted({*code, *shared, *(ROOT / "tests").glob("*.py"), file}):
        made.update(path.as_posix().encode() + path.read_bytes())
    return made.hexdigest()[:24]


def _by_cost(tests: Sequence[str], seconds: dict[str, float], order: dict[str, int]) -> list[str]:
    """The cheapest files first, each file's tests together."""
    cost: dict[str, float] = defaultdict(float)
    for test in tests:
        cost[test.partition("::")[0]] += seconds[test]
    return sorted(tests, key=lambda t: (cost[t.partition("::")[0]], order[t]))


def _prepare(items: Sequence[pytest.Item], folder: Path) -> None:
    """Begin the child's life: a process group, no output, temporary folders of its own."""
    os.setpgid(0, 0)
    folder.mkdir(parents=True)
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    factory = items[0].config._tmp_path_factory  # type: ignore[attr-defined]
    factory._basetemp = folder / "tests"
    factory._basetemp.mkdir()


def _run(items: Sequence[pytest.Item]) -> Iterator[tuple[pytest.Item, str]]:
    """Each test and what became of it: passed, failed or skipped."""
    for item, following in zip(items, [*items[1:], None], strict=True):
        reports = runtestprotocol(item, log=False, nextitem=following)
        yield item, next((word for word in ("failed", "skipped") if any(r.outcome == word for r in reports)), "passed")


def _fork(
    mutant: Mutant, functions: Sequence[FunctionType], items: Sequence[pytest.Item], limit: float, folder: Path
) -> int:
    """Start a process that ends with 0 where all tests pass."""
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        _prepare(items, folder)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        seconds = int(limit)
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        if _break_in_place(mutant, functions):
            status = 0 if all(became != "failed" for _, became in _run(items)) else 1
        else:
            arguments = [sys.executable, "-m", "tests.verify.mutation", *(item.nodeid for item in items)]
            arguments.insert(3, str(folder / "own"))
            environment = {**os.environ, _MUTANT: str(mutant.number)}
            status = subprocess.run(arguments, env=environment, cwd=ROOT, timeout=4 * seconds).returncode
    finally:
        os._exit(status)


def _break_in_place(mutant: Mutant, functions: Sequence[FunctionType]) -> bool:
    """Give the functions the broken code; False where there is none, or it cannot be."""
    code = compile(broken(mutant), str(ROOT / mutant.file), "exec") if mutant.function else None
    turned = 0
    for function in functions if code is not None else ():
        for made in _codes(code):
            own = function.__code__
            same = made.co_qualname == own.co_qualname and made.co_firstlineno == own.co_firstlineno
            if same and made.co_freevars == own.co_freevars:
                function.__code__ = made
                turned += 1
    return turned > 0


def _codes(code: CodeType) -> Iterator[CodeType]:
    for each in code.co_consts:
        if isinstance(each, CodeType):
            yield each
            yield from _codes(each)


def _fork_map(files: dict[Path, list[pytest.Item]], folder: Path) -> int:
    """Start a process that runs the tests of some files, and writes for each which lines they run."""
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        items = [item for each in files.values() for item in each]
        _prepare(items, folder)
        contexts = _Contexts()
        items[0].config.pluginmanager.register(contexts)
        for file, own in files.items():
            measured = contexts.start()
            seconds, began = {}, time.process_time()
            for item, became in _run(own):
                ended = time.process_time()
                if became == "passed":
                    seconds[item.nodeid] = ended - began
                began = ended
            measured.stop()
            file.write_text(json.dumps({"lines": _lines(measured, own, seconds), "seconds": seconds}))
        status = 0
    finally:
        if status:
            traceback.print_exc()
        os._exit(status)


class _Contexts:
    """Tells coverage which test runs, or which fixture that several tests share."""

    context = ""

    def start(self) -> coverage.Coverage:
        """Measure anew."""
        places = [str(ROOT / room / "*") for room in ROOMS]
        self.measured = coverage.Coverage(data_file=None, include=places, config_file=False, messages=False)
        self.measured.set_option("run:disable_warnings", ["no-data-collected"])
        self.measured.start()
        return self.measured

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[Any]:
        if fixturedef.scope == "function":
            return (yield)
        outer = self.context
        self._switch(f"fixture {fixturedef.argname}")
        try:
            return (yield)
        finally:
            self._switch(outer)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        self._switch(item.nodeid)

    def _switch(self, context: str) -> None:
        self.context = context
        self.measured.switch_context(context)


def _lines(
    measured: coverage.Coverage, items: Sequence[pytest.Item], seconds: dict[str, float]
) -> dict[str, dict[str, list[str]]]:
    users: dict[str, list[str]] = defaultdict(list)
    for item in items:
        if item.nodeid in seconds:
            users[item.nodeid].append(item.nodeid)
            for name in getattr(item, "fixturenames", ()):
                users[f"fixture {name}"].append(item.nodeid)
    data = measured.get_data()
    found: dict[str, dict[str, list[str]]] = {}
    for file in data.measured_files():
        by_line = {
            str(line): sorted({t for c in contexts for t in users.get(c, ())})
            for line, contexts in data.contexts_by_lineno(file).items()
        }
        by_line[_ANY] = sorted({t for tests in by_line.values() for t in tests})
        found[Path(file).resolve().relative_to(ROOT).as_posix()] = by_line
    return found


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module with its break."""

    def __init__(self, mutant: Mutant) -> None:
        self.mutant = mutant

    def find_spec(self, name: str, path: object, target: object = None) -> object:  # type: ignore[override]
        if name != self.mutant.module:
            return None
        return importlib.util.spec_from_file_location(name, ROOT / self.mutant.file, loader=self)

    def create_module(self, spec: object) -> None:
        return None

    def exec_module(self, module: object) -> None:
        exec(compile(broken(self.mutant), self.mutant.file, "exec"), module.__dict__)


def main() -> int:
    """Run the tests that are named after a folder for theirs, with the mutant of the environment imported."""
    sys.meta_path.insert(0, _Finder(mutants()[int(os.environ[_MUTANT])]))
    return int(pytest.main([*_arguments(), f"--basetemp={sys.argv[1]}", *sys.argv[2:]]))


if __name__ == "__main__":
    sys.exit(main())
