"""What all tests share: the runtimes' processes, started once per session.

Every policy.json and parity.json that a test in this process writes is held against its JSON Schema.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from converters.formats import DEFAULTS, WRITTEN
from converters.policy import Policy
from converters.runtimes.pool import RuntimePool
from converters.runtimes.registry import available_runtimes

# pytest-xdist gives its workers 80; what a command prints is not to depend on how the tests are run.
os.environ.pop("COLUMNS", None)

#: What the tests that compare all formats run them in.
NEEDED = ("tensorflow", "onnxruntime", "onnxruntime-web", "tfjs-cpu", "tfjs-wasm")
#: Those of them that cost little: half of a verification's time is Node's.
QUICK = ("tensorflow", "onnxruntime")
#: Set, every policy of a sweep is run in all of NEEDED, as one with ops of its own always is.
FULL = "EXPORT_MODEL_TEST_FULL"

#: No time limit per example: on a busy machine it says nothing of the code. Each test has pytest's own.
settings.register_profile("busy", deadline=None)
settings.load_profile("busy")

#: Rooms whose tests start runtimes, browsers, servers or the program; and what tests of other rooms then ask for.
_ROOMS = frozenset(
    (
        *("acting", "bench", "browser", "chains", "corpus", "docs", "faults", "install", "legacy", "live", "peers"),
        *("runner", "serve", "trained"),
    )
)
_FIXTURE = "processes"

#: Where one file after the other runs the same lines, coverage traces one in so many: Python is two to three times as
#: slow under it (3.11 has no other way), and the lines are the same.
_TRACED = 8
_SWEEPS = ("corpus", "legacy")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what ``make check`` leaves out, and of sweeps what coverage does."""
    swept: Counter[str] = Counter()
    for item in items:
        rooms = set(item.path.relative_to(Path(__file__).parent).parts)
        if rooms & _ROOMS or _FIXTURE in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.runtimes)
        if config.pluginmanager.hasplugin("_cov") and any(item.get_closest_marker(name) for name in _SWEEPS):
            family = item.nodeid.partition("[")[0]
            if swept[family] % _TRACED:
                item.add_marker(pytest.mark.no_cover)
            swept[family] += 1


@pytest.fixture(scope="session")
def processes() -> Iterator[RuntimePool]:
    """The runtimes' processes: each is started when a test first asks for it, and only once per session."""
    with RuntimePool() as opened:
        yield opened


@pytest.fixture(scope="session")
def pool(processes: RuntimePool) -> RuntimePool:
    """The pool, where all of NEEDED can be started; skips, with how to install it, where one is not there."""
    missing = [i for i in available_runtimes() if i.name in NEEDED and not i.installed]
    if missing:
        pytest.skip(f"{missing[0].name} is not installed: {missing[0].how}")
    return processes


Chosen = Callable[[Sequence[Policy]], tuple[str, ...]]


@pytest.fixture(scope="session")
def runtimes_for(tmp_path_factory: pytest.TempPathFactory) -> Chosen:
    """What to run policies in: NEEDED where their ops and contract are met for the first time, else QUICK.

    Hundreds of public and genuine files are some dozen networks with other weights, and other weights reach no other
    line of a writer or a runtime's kernel. Of all workers one is the first: it makes the file of that name.
    """
    folder = tmp_path_factory.getbasetemp()
    met = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "structures"
    met.mkdir(exist_ok=True)

    def chosen(policies: Sequence[Policy]) -> tuple[str, ...]:
        if os.environ.get(FULL):
            return NEEDED
        name = hashlib.sha256(repr([structure(p) for p in policies]).encode()).hexdigest()
        try:
            (met / name).touch(exist_ok=False)
        except FileExistsError:
            return QUICK
        return NEEDED

    return chosen


def formats_in(runtimes: Sequence[str]) -> set[str]:
    """The default formats that are run in one of these."""
    return {f for f in DEFAULTS if set(WRITTEN[f].runtimes) & set(runtimes)}


def structure(policy: Policy) -> tuple[object, ...]:
    """The ops of a policy with their attributes, and its contract's roles, dtypes and ranks; no size and no weight."""
    left_out = ("shape", "seed", "seed2")
    ops = {
        (n.op, *sorted((key, str(value)) for key, value in n.attrs.items() if key not in left_out))
        for n in policy.graph.nodes
        if n.op != "Const"
    }
    signature = policy.signature
    specs = sorted((str(s.role), str(s.dtype), len(s.shape)) for s in (*signature.inputs, *signature.outputs))
    return sorted(map(repr, ops)), specs, len(signature.branches)


@pytest.fixture
def runtimes(pool: RuntimePool, monkeypatch: pytest.MonkeyPatch) -> RuntimePool:
    """All real runtimes; every command that this test runs shares their processes."""
    for module in ("exporter.export.again", "converters.runtimes.pool"):
        monkeypatch.setattr(f"{module}.RuntimePool", lambda: contextlib.nullcontext(pool))
    return pool


@pytest.fixture(scope="session", autouse=True)
def _what_is_written_fits_its_schema() -> Iterator[None]:
    from converters.bundle import bundle
    from tests.reports.validation import check_parity, check_policy

    written = bundle.dumps

    def checked(content: Mapping[str, Any]) -> bytes:
        data = written(content)
        if "comparisons" in content:
            check_parity(data)
        elif "files" in content:
            check_policy(data)
        return data

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bundle, "dumps", checked)
        yield
