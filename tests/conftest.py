"""What all tests share: the runtimes' processes, started once per session.

Every policy.json and parity.json that a test in this process writes is held against its JSON Schema.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from export_model.converters.formats.registry import DEFAULTS, WRITTEN
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes
from tests.tracing import Tracing

# pytest-xdist gives its workers 80; what a command prints is not to depend on how the tests are run.
os.environ.pop("COLUMNS", None)

#: What the tests that compare all formats run them in.
NEEDED = ("tensorflow", "onnxruntime", "onnxruntime-web", "tfjs-cpu", "tfjs-wasm")
#: The one of them that costs little: of a verification's time TensorFlow takes two fifths, Node half.
QUICK = ("onnxruntime",)
#: Set, every policy of a sweep is run in all of NEEDED, as one that has something new always is.
FULL = "EXPORT_MODEL_TEST_FULL"

#: Set (by make check), properties are tried on a fifth of their examples.
DAILY = "EXPORT_MODEL_TEST_DAILY"

#: No time limit per example, nor for making one: on a busy machine it says nothing of the code. Each test has pytest's
#: own. The same examples in every run, but where this is set (by ``make fuzz``): they are drawn anew.
ANEW = "EXPORT_MODEL_TEST_ANEW"
SLOW = (HealthCheck.too_slow,)
settings.register_profile("busy", deadline=None, derandomize=ANEW not in os.environ, suppress_health_check=SLOW)
settings.load_profile("busy")

#: Rooms whose tests start runtimes, compilers, browsers, servers or the program.
_ROOMS = frozenset(
    (
        *("acting", "bench", "browser", "c", "chains", "corpus", "docs", "faults", "fleet", "fuzz", "install"),
        *("legacy", "live", "peers", "programs", "runtimes", "serve", "trained"),
    )
)
#: What tests of other rooms ask for then.
_FIXTURE = "processes"


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Tracing(config), Tracing.NAME)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what ``make check`` leaves out, and of sweeps what coverage does; tell pytest-xdist the groups."""
    config.pluginmanager.getplugin(Tracing.NAME).mark(items)
    for item in items:
        rooms = set(item.path.relative_to(Path(__file__).parent).parts)
        if rooms & _ROOMS or _FIXTURE in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.runtimes)
        groups = sorted({mark.args[0] for mark in item.iter_markers("xdist_group")})
        if groups and config.getoption("loadgroup", False) and hasattr(item, "_id"):
            # pytest-xdist 3.8 writes it to a field that pytest 9.2 no longer reads: each worker made all fixtures.
            item._id = type(item._id).parse(f"{item.nodeid}@{'_'.join(groups)}")  # type: ignore[attr-defined]


def examples(count: int, **options: Any) -> settings:
    """Settings of a property that is dear: so many examples, fewer in the daily loop."""
    return settings(deadline=None, max_examples=max(count // 5, 5) if DAILY in os.environ else count, **options)


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
def is_new(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Sequence[Policy]], bool]:
    """(sweep, policies) → whether they have a feature that none before them in this session's sweep had.

    Hundreds of public and genuine files are some dozen networks with other weights, and other weights reach no other
    line of a writer or a runtime's kernel. Of all workers one is the first: it makes the file of that name.
    """
    folder = tmp_path_factory.getbasetemp()
    met = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "features"
    met.mkdir(exist_ok=True)

    def new(sweep: str, policies: Sequence[Policy]) -> bool:
        found = bool(os.environ.get(FULL))
        for feature in {f for policy in policies for f in features(policy)}:
            with contextlib.suppress(FileExistsError):
                (met / hashlib.sha256(f"{sweep} {feature}".encode()).hexdigest()).touch(exist_ok=False)
                found = True
        return found

    return new


@pytest.fixture(scope="session")
def runtimes_for(is_new: Callable[[str, Sequence[Policy]], bool]) -> Chosen:
    """What to run policies in: NEEDED where they have something new, else QUICK."""
    return lambda policies: NEEDED if is_new("runtimes", policies) else QUICK


def features(policy: Policy) -> Iterator[str]:
    """Each op with its attributes, each pair of ops one of which reads the other, each role with its dtype and rank."""
    ops = {n.name: n.op for n in policy.graph.nodes}
    for node in policy.graph.nodes:
        if node.op != "Const":
            attributes = {k: str(v) for k, v in node.attrs.items() if k not in ("shape", "seed", "seed2")}
            yield f"{node.op} {sorted(attributes.items())}"
            yield from (f"{ops.get(name.partition(':')[0])} → {i} of {node.op}" for i, name in enumerate(node.inputs))
    signature = policy.signature
    for spec in (*signature.inputs, *signature.outputs):
        yield f"{spec.role} {spec.dtype} of rank {len(spec.shape)}"
    yield f"{min(len(signature.branches), 2)} branches"


def formats_in(runtimes: Sequence[str]) -> set[str]:
    """The default formats that are run in one of these."""
    return {f for f in DEFAULTS if set(WRITTEN[f].runtimes) & set(runtimes)}


@pytest.fixture
def runtimes(pool: RuntimePool, monkeypatch: pytest.MonkeyPatch) -> RuntimePool:
    """All real runtimes; every command that this test runs shares their processes."""
    for module in ("export_model.exporter.export.again", "export_model.converters.runtimes.pool"):
        monkeypatch.setattr(f"{module}.RuntimePool", lambda: contextlib.nullcontext(pool))
    return pool


@pytest.fixture(scope="session", autouse=True)
def _what_is_written_fits_its_schema() -> Iterator[None]:
    from export_model.converters.formats.bundle import bundle
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
