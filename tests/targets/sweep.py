"""Every policy at hand under every profile: what is held, what is refused and why.

``python -m tests.figures --profiles`` writes the counts into docs/figures. Held is what is written, has no construct or
layer that an importer of the profile misreads, is accepted by our checkers of its releases and, where a pool is given,
acts the same with 1, 3 and 16 agents.
"""

from __future__ import annotations

import functools
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from export_model.converters.consumers.profile import Profile
from export_model.converters.consumers.profiles import PROFILES
from export_model.converters.consumers.unity.checker import check_file
from export_model.converters.consumers.unity.consumers import consumer
from export_model.converters.formats.barracuda.writer import encode
from export_model.converters.formats.source import ReadOptions
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import ExportModelError
from tests.barracuda.test_writer import assert_answers
from tests.barracuda.test_writer import written as written_nn
from tests.corpus.conftest import SHARED
from tests.legacy.test_profiles_in_tf1 import ATOL, runtime_of
from tests.targets.dressed import Pair

BATCHES = (1, 3, 16)
_SUFFIXES = (".bytes", ".pb", ".nn", ".onnx", ".pt", ".keras")
#: What the weights of a .pt do not tell.
SENSORS = {"mla_ppo_vis_fully_connected.pt": ((1, 12, 12),)}


@dataclass
class Cell:
    """What came of one profile in one format; ``wrong`` are policies that act otherwise or are not accepted."""

    held: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        refused = dict(sorted(self.refused.items(), key=lambda item: (-item[1], item[0])))
        return {"held": self.held, "refused": refused, "wrong": self.wrong}


def sources() -> list[Path]:
    """Every file that may hold a policy, and every folder of a run."""
    rooms = [SHARED / room for room in ("genuine", "corpus", "foreign")]
    files = [p for room in rooms for p in sorted(room.rglob("*")) if p.suffix in _SUFFIXES and p.is_file()]
    folders = {p.parent for room in rooms for p in room.rglob("checkpoint") if p.is_file()}
    return [*files, *sorted(folders)]


def reason(error: ExportModelError) -> str:
    """A refusal without the names of the policy, its nodes and its numbers."""
    text = re.sub(r"^.* cannot be made for [\w.-]+: ", "", error.what)
    text = re.sub(r"node '.*' \((\w+)\)", r"\1", text)
    text = re.sub(r"has \d+ branches", "has several branches", text)
    text = re.sub(r"its observation \w+ is", "one of its observations is", text)
    text = re.sub(r"its memory \(.*\)", "its memory", text)
    text = re.sub(r"it reshapes the memory \w+", "it reshapes its memory", text)
    return re.sub(r"Reshape cannot be written to a .nn: .*\['\?.*", "it has rows for each of several entities", text)


def tried(
    policy: Policy,
    wanted: Profile,
    form: str,
    pool: RuntimePool | None,
    acted: dict[bytes, str | None],
    atol: float = 1e-5,
) -> tuple[str, str]:
    """(held, refused or wrong; why). ``acted`` has what the policy's files for other profiles do otherwise."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            if form in wanted.own_names:
                return _tried_own(policy, wanted, pool, Path(folder))
            pair = Pair.of(policy, wanted, form=form)
        except ExportModelError as error:
            return "refused", reason(error)
        except AssertionError as error:
            return "wrong", str(error)[:200]
        try:
            if pool is not None and pair.data not in acted:
                acted[pair.data] = _acts_otherwise(pair, pool, Path(folder), atol)
            other = acted.get(pair.data)
        except AssertionError as error:
            return "wrong", str(error)[:200]
        if other is not None:
            return "wrong", other
        for release, verdict in pair.verdicts(Path(folder)).items():
            modes = ["stochastic"] if wanted.name == "barracuda-1.0" else list(verdict.checked)
            if not all(verdict.checked[mode] for mode in modes):
                return "wrong", f"{release} does not accept it"
    return "held", ""


def _tried_own(policy: Policy, wanted: Profile, pool: RuntimePool | None, folder: Path) -> tuple[str, str]:
    """A .nn of API version 2. Release 20 reads it too, but for one with a memory."""
    model = written_nn(policy)
    if pool is not None:
        assert_answers(policy, model, BATCHES)
    path = folder / "policy.nn"
    path.write_bytes(encode(model))
    accepted = [check_file(path, consumer(r)).checked["stochastic"] for r in wanted.checkers if not model.memories]
    return ("held", "") if all(accepted) else ("wrong", "R20 does not accept it")


def _acts_otherwise(pair: Pair, pool: RuntimePool, folder: Path, atol: float) -> str | None:
    model = None
    if pair.form == "bytes":
        file = folder / "policy.bytes"
        file.write_bytes(pair.data)
        model = pool.process(_runtime(pair.profile.name)).load(str(file))
    for seed, rows in enumerate(BATCHES):
        found = pair.difference(rows, seed, None if model is None else model.run, atol)
        if found is not None:
            return f"batch {rows}: {found}"
    if model is not None:
        model.unload()
    return None


@functools.cache
def _runtime(name: str) -> str:
    return runtime_of(next(p for p in PROFILES if p.name == name))


def swept(files: Sequence[Path], pool: RuntimePool | None = None, names: Collection[str] = ()) -> dict[str, Any]:
    """Everything that is counted, as JSON; ``names`` are the profiles, where none is given all of ML-Agents'."""
    wanted = [p for p in PROFILES if (p.name in names if names else not p.loaders)]
    cells = {(p.name, form): Cell() for p in wanted for form in p.formats}
    unread: Counter[str] = Counter()
    policies = 0
    for number, (path, found) in enumerate(_read(files, unread), 1):
        print(f"{number} of {len(files)}: {path.name}", file=sys.stderr, flush=True)
        atol, _ = ATOL.get(path.name, (1e-5, ""))
        for policy in found:
            policies += 1
            acted: dict[bytes, str | None] = {}
            for profile in wanted:
                for form in profile.formats:
                    outcome, why = tried(policy, profile, form, pool, acted, atol)
                    cell = cells[profile.name, form]
                    cell.held += outcome == "held"
                    if outcome == "refused":
                        cell.refused[why] += 1
                    elif outcome == "wrong":
                        cell.wrong.append(f"{path.relative_to(SHARED)}: {why}")
    return {
        "files": len(files),
        "unread": dict(sorted(unread.items())),
        "policies": policies,
        "profiles": [{"profile": p, "format": f, **cell.to_dict()} for (p, f), cell in cells.items()],
    }


def _read(files: Sequence[Path], unread: Counter[str]) -> Iterator[tuple[Path, list[Policy]]]:
    for path in files:
        try:
            options = ReadOptions(sensors=SENSORS.get(path.name, ()), trust_source=path.suffix == ".keras")
            yield path, read_source(path, options).policies()
        except ExportModelError as error:
            unread[re.sub(r"'[^']*'", "…", error.what)] += 1
