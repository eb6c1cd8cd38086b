"""Hostile contracts: a good one with a few values exchanged, so that most of it holds and the rest is looked at.

Each is put into a bundle whose files it names rightly, and into the graph as the contract that it embeds: what refuses
it is the contract's own check, or nothing does.
"""

from __future__ import annotations

import contextlib
import copy
import json
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.serve import site
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.digest import sha256_hex
from export_model.signatures.errors import ExportModelError
from export_model.signatures.roles import Role
from fixtures import path as fixture
from tests.commands import export_model
from tests.exporting import load_policy

POLICIES = ("continuous", "recurrent", "discrete", "visual", "sampled")
#: Seconds of computing that a command may take.
SECONDS = 20.0

#: What acts in a terminal, a page, a script, a shell, a path.
TEXTS = (
    *("", " ", "a\nb", "\x1b[2J", "\x1b]52;c;eA==\x07", "\x9b31m", "\u202eevil", "\ud800", "\x00", "😀", "a" * 5000),
    *("</script><script>alert(1)</script>", "<!--", '"); import os; os.system("x") #', "'; touch x; '", "${x}", "$(x)"),
    *("../../x", "/etc/passwd", "C:\\x", "tfjs/../x", "JSON", "PYTHON", "*/", "__proto__", "constructor", "%s{0}"),
)
NUMBERS = (
    *(0, 1, -1, 2, 3, 7, 8, 255, 2**31 - 1, 2**31, 2**63 - 1, 2**63, -(2**63), 2**64, 10**30, 10**400),
    *(0.5, -0.0, 1e308, -1e308, 5e-324, True, False),
)
#: What JSON's text may say besides: no contract has them.
BEYOND = (*(None,) * 20, "NaN", "Infinity", "-Infinity", "1e999", "-1e999")
ROLES = tuple(role.value for role in Role)
DTYPES = ("bool", "float16", "float32", "float64", "int8", "uint8", "int64", "uint64", "object", "str", "complex64")
WORDS = (*ROLES, *DTYPES, "NHWC", "NCHW", "normal", "uniform", "integer", "mask", "continuous", "discrete", "hybrid")

values = st.one_of(
    st.sampled_from(TEXTS),
    st.sampled_from(NUMBERS),
    st.sampled_from(WORDS),
    st.none(),
    st.just([]),
    st.just({}),
    st.lists(st.one_of(st.sampled_from(NUMBERS), st.none()), max_size=6),
    st.builds(lambda depth: json.loads("[" * depth + "]" * depth), st.sampled_from((40, 70))),
    st.builds(
        lambda kind, a, b: {"kind": kind, "low": a, "high": b, "mean": a, "std": b},
        st.sampled_from(("normal", "uniform", "integer", "mask")),
        *(st.sampled_from(NUMBERS),) * 2,
    ),
)
#: Changes: where (a number chooses among all places), what to do there, with what.
changes = st.lists(
    st.tuples(
        st.integers(0, 10_000), st.sampled_from(("like", "like", "like", "set", "name", "drop", "twice")), values
    ),
    min_size=1,
    max_size=3,
)


def changed(content: dict[str, Any], how: list[tuple[int, str, Any]]) -> dict[str, Any]:
    """A copy of the contract with changes made."""
    made = copy.deepcopy(content)
    for number, deed, value in how:
        places = list(_places(made))
        holder, key = places[number % len(places)]
        if deed == "like":
            holder[key] = _like(holder[key], number)
        elif deed == "drop":
            del holder[key]
        elif deed == "twice" and isinstance(holder, list):
            holder.insert(key, copy.deepcopy(holder[key]))
        elif deed == "name" and isinstance(holder, dict) and isinstance(value, str):
            holder[value] = holder.pop(key)
        else:
            holder[key] = value
    return made


def _like(value: Any, number: int) -> Any:
    """Another value of the same kind, which a check that looks at one field alone lets pass."""
    groups = (ROLES, DTYPES[:8], ("normal", "uniform", "integer", "mask"), ("continuous", "discrete", "hybrid"))
    if isinstance(value, str):
        other = ("a", "b c", "</script>", "it's", "😀", "*/", "`x`", "${x}")
        group = next((g for g in groups if value in g), other)
        return group[number % len(group)]
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float) or value is None:
        return (None, 0, 1, 2, 3, 7, 8, 84, 1000, 60_000, 2**22, 2**31 - 1, 0.25, -1e30)[number % 14]
    if isinstance(value, list):
        return (value[1:], value[:-1], value[::-1], [*value, *value], [value], [None, *value])[number % 6]
    return dict(list(value.items())[1:])


def _places(value: Any) -> Any:
    """(object or list, key or index) of every value inside, files apart: those are put right afterwards."""
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in list(entries):
        if key != "files":
            yield value, key
            yield from _places(inner)


def write(folder: Path, content: dict[str, Any], graph: bytes, beyond: str | None = None) -> Path:
    """A bundle of one ``.bytes`` (and TensorFlow.js' files as they lie there) that says ``content``; the ``.bytes``."""
    given = content.get("name")
    name = given if isinstance(given, str) and not {*given} & {*"/\\\0"} else "policy"
    plain = {key: value for key, value in content.items() if key != "files"}
    text = json.dumps(plain)
    file = name if 0 < len(name) < 100 and name.isprintable() else "policy"
    made = schema.GraphDef.FromString(graph)
    (kept,) = (node for node in made.node if node.name == EMBEDDED)
    kept.attr["value"].tensor.string_val[:] = [text.encode()]
    data = made.SerializeToString(deterministic=True)
    (folder / f"{file}.bytes").write_bytes(data)
    held = {f"{file}.bytes": data, **{f"tfjs/{p.name}": p.read_bytes() for p in sorted((folder / "tfjs").glob("*"))}}
    files = {path: {"sha256": sha256_hex(d), "bytes": len(d)} for path, d in held.items()}
    whole = json.dumps({**plain, "files": files})
    if beyond is not None:
        whole = whole.replace("0.0", beyond, 1)
    (folder / "policy.json").write_text(whole)
    return folder / f"{file}.bytes"


class Trial:
    """Bundles of fixtures whose contracts are changed, and every command that reads one."""

    def __init__(self, home: Path, pool: RuntimePool) -> None:
        self.home, self.pool = home, pool
        self.good: list[tuple[dict[str, Any], bytes, Path]] = []
        #: (command, status) → how often
        self.ended: Counter[tuple[object, int]] = Counter()
        for name in POLICIES:
            ran = export_model(fixture(name), "-o", home, "--to", "bytes,tfjs", "--verify", "none")
            assert ran.status == 0, ran.err
            content = json.loads((home / name / "policy.json").read_text())
            self.good.append((content, (home / name / f"{name}.bytes").read_bytes(), home / name / "tfjs"))

    def run(self, which: int, how: list[tuple[int, str, Any]], beyond: str | None) -> None:
        """Raises AssertionError, or what a command let through."""
        content, graph, tfjs = self.good[which]
        with tempfile.TemporaryDirectory(dir=self.home) as scratch:
            folder, out = Path(scratch) / "given", Path(scratch) / "out"
            shutil.copytree(tfjs, folder / "tfjs")
            file = write(folder, changed(content, how), graph, beyond)
            before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
            with pytest.MonkeyPatch.context() as patch:
                for module in (
                    "export_model.exporter.export.again",
                    "export_model.exporter.compare.comparison",
                    "export_model.converters.runtimes.pool",
                ):
                    patch.setattr(f"{module}.RuntimePool", lambda: contextlib.nullcontext(self.pool))
                patch.setattr(site, "_vendor", lambda *_: ({}, [], []))
                for command in _commands(folder, file, self.home, out):
                    self._ran(*command)
            with contextlib.suppress(ExportModelError):
                policy = load_policy(folder, runtime="numpy")
                policy.decide(
                    {s.name: np.zeros([n or 1 for n in s.shape], s.dtype) for s in policy.signature.observations}
                )
            assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before
            assert {p.name for p in Path(scratch).iterdir()} <= {"given", "out"}

    def _ran(self, *command: object) -> None:
        begun = time.process_time()
        ran = export_model(*command)
        said = ran.out + ran.err
        assert ran.status in (0, 1, 2, 3), said
        assert "Traceback" not in said
        assert "did not expect" not in said, said
        assert not [c for c in said if not c.isprintable() and c != "\n"], said
        assert time.process_time() - begun < SECONDS, command
        self.ended[command[0], ran.status] += 1


def _commands(folder: Path, file: Path, good: Path, out: Path) -> list[tuple[object, ...]]:
    runtimes = ("--runtimes", "numpy", "--allow-unverified")
    return [
        ("verify", folder, *runtimes),
        ("snippets", folder),
        ("serve", folder, "-o", out),
        ("inspect", folder),
        ("inspect", file),
        ("compare", folder, folder, *runtimes),
        ("compare", good / POLICIES[0], file, *runtimes),
    ]


def main() -> None:
    """``python -m tests.hostile.contracts [COUNT [SEED]]``: so many contracts, for ``make fuzz``."""
    count, number = (int(text) for text in [*sys.argv[1:], *("3000", "0")[len(sys.argv) - 1 :]])
    with tempfile.TemporaryDirectory() as home, RuntimePool() as pool:
        trial = Trial(Path(home), pool)

        @seed(number)
        @settings(max_examples=count, deadline=None, database=None, suppress_health_check=list(HealthCheck))
        @given(st.integers(0, len(POLICIES) - 1), changes, st.sampled_from(BEYOND))
        def tried(which: int, how: list[tuple[int, str, Any]], beyond: str | None) -> None:
            trial.run(which, how, beyond)

        tried()
        for (command, status), times in sorted(trial.ended.items(), key=str):
            print(f"{command}: status {status}, {times} times")


if __name__ == "__main__":
    main()
