"""A process that makes mutants and gives them to the commands, under limits; it says what came of each.

``python -m tests.fuzz.worker READER...`` reads lines ``FIRST LAST``, and answers ``> NUMBER`` before a mutant and JSON
after it. It is started by ``tests.fuzz.run``, which ends it where it hangs.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.formats.bundle.bundle import Bundle
from export_model.converters.formats.keras.config import config_of, refuse_code
from export_model.converters.formats.keras.source import build_layered
from export_model.converters.formats.keras.weights import Groups
from export_model.converters.formats.read import ports_of
from export_model.converters.formats.registry import WRITTEN
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.inspect.inspection import inspect_source, inspection_text
from export_model.exporter.snippets.contract import read_bundle
from export_model.exporter.snippets.registry import snippets
from export_model.exporter.verify.golden import read_golden
from export_model.signatures.errors import ExportModelError, SourceError, naming
from export_model.signatures.spec import PolicySignature
from tests.exporting import load_policy
from tests.fuzz.seeds import READERS, Files, mutant

#: What a mutant may take: seconds of computing, bytes above what the process had when it was ready.
SECONDS, MEMORY = 2.0, 512 << 20
#: What the last nets of a command say (exporter/export/sources.py); a check of its own should have.
_NETS = ("did not expect", "cannot be understood")
_ROOT = Path(__file__).resolve().parents[2]


def _source(path: Path, out: Path) -> None:
    """``inspect``, which asks all writers too."""
    inspection = inspect_source(path)
    inspection_text(inspection)
    json.dumps(inspection.to_dict())
    refused = {r for p in inspection.policies for r in p.targets.values() if r is not None}
    if any(net in r for r in refused for net in _NETS):
        raise SourceError("a writer", why="did not expect something")


def _exported(path: Path, out: Path) -> None:
    """An export without verification, in the smallest format; the others were written by ``inspect``."""
    list(export([path], ExportOptions(out, ("bytes",), verify="none")))


def _candidate(path: Path, out: Path) -> None:
    """What ``compare`` reads of an artefact before a runtime is given it."""
    for number, (found, ports) in enumerate(ports_of(path)):
        if found.vetted is not None:
            folder = out / f"vetted{number}"
            folder.mkdir(parents=True)
            signature = [str(ports.options["signature"])] if found.signatures else [p.name for p in ports.outputs]
            with naming(path):
                found.vetted(ports.path, signature, folder)


def _bundle(path: Path, out: Path) -> None:
    """A bundle that anyone may have made: ``snippets``, ``load_policy``."""
    Bundle.open(path).verify_hashes()
    snippets(read_bundle(path), None)
    if (path / "policy.json").is_file() and WRITTEN["bytes"].first_file_of(Bundle.open(path).name):
        policy = load_policy(path, runtime="numpy")
        given = {s.name: [[0.0] * (s.shape[1] or 1)] for s in policy.signature.observations if len(s.shape) == 2}
        policy.decide(given)


def _recording(path: Path, out: Path) -> None:
    read_golden(path / "recorded.npz", _signature((path / "policy.bytes").read_bytes()))


@cache
def _signature(data: bytes) -> PolicySignature:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "policy.bytes")
        file.write_bytes(data)
        return inspect_source(file).policies[0].policy.signature


def _configuration(path: Path, out: Path) -> None:
    """A ``.keras``, but that its weights lie beside it: no process reads them."""
    with naming(path):
        config = config_of(path)
        refuse_code(config)
        with np.load(path.with_name("weights.npz")) as stored:
            build_layered((path,), config, Groups(dict(stored)), "3.0.0")


def _inspect_stored(path: Path, out: Path) -> None:
    """An ``.h5``, its bytes read by h5py in the confined child; a process each, so ``inspect`` alone."""
    inspection_text(inspect_source(path))


COMMANDS: dict[str, tuple[Callable[[Path, Path], None], ...]] = {
    "source": (_source, _candidate, _exported),
    "bundle": (_source, _bundle, _candidate),
    "recording": (_recording,),
    "configuration": (_configuration,),
    "stored": (_inspect_stored,),
}


def _place(error: BaseException) -> str:
    """Where in the product an exception came from."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if Path(f.filename).is_relative_to(_ROOT) and "tests" not in f.filename]
    frame = ours[-1] if ours else frames[-1]
    return f"{Path(frame.filename).name}:{frame.lineno} {frame.name}"


def attempt(files: Files, main: str, takes: str, top: Path) -> dict[str, Any]:
    """What comes of a mutant: ``ok``, ``refused``, or the failure, with what was said and where it came from."""
    given, out = top / "given", top / "out"
    for name, data in files.items():
        target = given / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
    outcome: dict[str, Any] = {"kind": "ok", "seconds": 0.0}
    for command in COMMANDS[takes]:
        begun = time.process_time()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                command(given / main, out)
        except ExportModelError as error:
            cause = error.__cause__
            said = f"{error.what} {error.why}"
            if any(net in said for net in _NETS):
                outcome = {"kind": "net", "said": str(error)[:300], "place": _place(cause or error)}
            elif isinstance(cause, MemoryError) or "needs more memory" in said:
                outcome = {"kind": "memory", "said": str(error)[:300], "place": _place(cause or error)}
            elif not (error.why or error.fix) or error.exit_status != 2:
                outcome = {"kind": "unclear", "said": str(error)[:300], "place": _place(error)}
            elif command is COMMANDS[takes][0]:
                outcome = {"kind": "refused", "said": type(error).__name__}
        except Warning as error:
            outcome = {"kind": "warning", "said": f"{type(error).__name__}: {error}"[:300], "place": _place(error)}
        except MemoryError as error:
            outcome = {"kind": "memory", "said": "MemoryError", "place": _place(error)}
        except Exception as error:  # noqa: BLE001 (that is what is looked for)
            said = f"{type(error).__name__}: {error}"[:300]
            outcome = {"kind": "traceback", "said": said, "place": _place(error)}
        taken = time.process_time() - begun
        outcome["seconds"] = max(taken, outcome.get("seconds", 0.0))
        if taken > SECONDS and outcome["kind"] in ("ok", "refused"):
            outcome.update(kind="slow", said=f"{taken:.1f} s", place=command.__name__)
        if outcome["kind"] not in ("ok", "refused"):
            break
        if command is _candidate and outcome["kind"] == "refused" and sum(map(len, files.values())) % 8:
            break  # an export would refuse it alike; some are tried for what they leave behind
    there = {p.relative_to(given).as_posix() for p in given.rglob("*") if not p.is_dir()}
    if there != set(files) or {p.name for p in top.iterdir()} - {"given", "out"}:
        outcome.update(kind="stray", said=str(sorted(there ^ set(files)))[:200], place="")
    shutil.rmtree(top)
    top.mkdir()
    return outcome


def _numbers() -> Iterator[int]:
    for line in sys.stdin:
        first, last = map(int, line.split())
        yield from range(first, last)


def main(readers: list[str]) -> None:
    """Answer until the input ends; the readers take turns."""
    top = Path(tempfile.mkdtemp(prefix="export-model-fuzz-"))
    os.environ["TMPDIR"] = tempfile.tempdir = str(top)
    say = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    try:
        for reader in readers:  # the modules that are imported on demand are no mutant's doing
            chosen = READERS[reader]
            for files in chosen.seeds()[:4]:
                whole = chosen.main in files or not chosen.main
                attempt(files if whole else mutant(reader, -1), chosen.main, chosen.takes, top)
        base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
        mapped = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + MEMORY, mapped + MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        say.write("ready\n")
        for number in _numbers():
            say.write(f"> {number}\n")
            reader = readers[number % len(readers)]
            chosen = READERS[reader]
            outcome = attempt(mutant(reader, number // len(readers)), chosen.main, chosen.takes, top)
            grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10) - base
            if grown > MEMORY:
                outcome.update(kind="memory", said=f"{grown >> 20} MiB", place="")
            say.write(json.dumps(outcome) + "\n")
    finally:
        shutil.rmtree(top, ignore_errors=True)


if __name__ == "__main__":
    main(sys.argv[1:])
