"""TensorFlow 2 by its C interface answers as its Python does, to the bit: every form that we write, and the original.

``tf.saved_model.load`` and ``Session.run`` are what users call; verification runs the C interface, which costs a fifth.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.files.children.process import RunFailedError, RuntimeProcess
from export_model.converters.files.children.python import child_command
from export_model.converters.formats.registry import FROZEN_GRAPH
from export_model.converters.formats.saved_model.writer import signatures_of
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import RUNTIMES
from export_model.exporter.export.pipeline import ExportOptions, ExportResult, export
from export_model.exporter.verify.findings import Draws, Size
from export_model.signatures.roles import Role
from export_model.signatures.sampling import draw_cases
from fixtures import FIXTURES, FOLDER, path
from tests.corpus.conftest import genuine_cases
from tests.handmade import graph_bytes, node, placeholder

pytestmark = [
    pytest.mark.xdist_group("tensorflow-python"),
    pytest.mark.skipif(sys.platform != "linux", reason="only the wheels for Linux have the library"),
]
IsNew = Callable[[str, Sequence[Policy]], bool]
_COMMANDS = {r.name: r.command for r in RUNTIMES}
_C, _PYTHON = "tensorflow", "tensorflow-python"
SOURCES = [
    *(pytest.param(path(name), id=name) for name in FIXTURES),
    *(
        pytest.param(f / c["frozen"]["file"], id=f"genuine-{f.name}", marks=[pytest.mark.slow, pytest.mark.corpus])
        for f, c in genuine_cases()
    ),
]


@pytest.fixture(scope="module")
def pools() -> Iterator[tuple[RuntimePool, RuntimePool]]:
    """One whose TensorFlow is the C interface, and one whose is Python's; ended with this file for their memory."""
    with RuntimePool() as ours, RuntimePool({**_COMMANDS, _C: _COMMANDS[_PYTHON]}) as theirs:
        yield ours, theirs


@pytest.mark.parametrize("source", SOURCES)
def test_both_answer_the_same_bits(
    source: Path, pools: tuple[RuntimePool, RuntimePool], is_new: IsNew, tmp_path: Path
) -> None:
    policies = [r.policy for r in export([source], ExportOptions(tmp_path / "first", ("bytes",), verify="none"))]
    if not is_new("tensorflow-python", policies) and source.parent != FOLDER:
        return  # the same ops, with other weights
    options = [ExportOptions(tmp_path / name, ("bytes", "saved_model"), verify=_C) for name in ("c", "python")]
    results, others = (list(export([source], o, pool=p)) for o, p in zip(options, pools, strict=True))
    for result, other in zip(results, others, strict=True):
        assert result.report is not None
        assert other.report is not None
        assert result.report.runtimes[_C]["version"].endswith(" (C interface)")
        assert result.report.reference == "source/tensorflow"
        assert _findings(result) == _findings(other)
        _compare_answers(result, pools)


def _findings(result: ExportResult) -> list[Any]:
    assert result.report is not None
    return [
        (f.format, f.output, f.passed) if isinstance(f, Draws) else f  # what is drawn, is drawn anew
        for f in result.report.comparisons
        if not isinstance(f, Size)
    ]


def _compare_answers(result: ExportResult, pools: Sequence[RuntimePool]) -> None:
    policy = result.policy
    inputs = [case.feeds for case in draw_cases(policy.signature)]
    file = result.folder / FROZEN_GRAPH.main_of(policy.name)
    called = [(file, {"kind": "graph"}, policy.signature.inputs, policy.signature.outputs)]
    for key, sides in signatures_of(policy).items():
        called.append((result.folder / "saved_model", {"kind": "saved_model", "signature": key}, *sides))
    for model, options, taken, given in called:
        outputs = [s.name for s in given if s.role is not Role.SAMPLED]
        feeds = [{s.name: case[s.name] for s in taken} for case in inputs]
        ours, theirs = (_answers(pool, model, options, feeds, outputs) for pool in pools)
        for mine, other in zip(ours, theirs, strict=True):
            for name in outputs:
                assert (mine[name].dtype, mine[name].shape) == (other[name].dtype, other[name].shape)
                assert mine[name].tobytes() == other[name].tobytes(), name


def _answers(
    pool: RuntimePool,
    file: Path,
    options: Mapping[str, Any],
    inputs: Sequence[Mapping[str, np.ndarray]],
    outputs: Sequence[str],
) -> list[dict[str, np.ndarray]]:
    with pool.process(_C).load(str(file), **options) as model:
        return model.run_all(inputs, outputs)


def test_an_array_is_held_against_what_it_is_fed_to(pools: tuple[RuntimePool, RuntimePool], tmp_path: Path) -> None:
    """The C API looks at no shape: a placeholder for one agent would take two."""
    model = tmp_path / "one.bytes"
    model.write_bytes(graph_bytes([placeholder("state", (1, 3)), node("action", "Identity", "state", T=np.float32)]))
    for pool in pools:
        with pool.process(_C).load(str(model), kind="graph") as loaded:
            row = np.ones(3, np.float32)
            assert loaded.run({"state": row}, ["action", "state"])["state"].tolist() == [[1, 1, 1]]
            assert loaded.run({"state": row.astype(np.int64)}, ["action"])["action"].dtype == np.float32
            for wrong in (np.ones((2, 3), np.float32), np.ones((1, 4), np.float32)):
                with pytest.raises(RunFailedError, match="shape"):
                    loaded.run({"state": wrong}, ["action"])


def test_where_the_library_does_not_load_python_runs_and_says_so(tmp_path: Path) -> None:
    command = child_command(
        "export_model.converters.runtimes.tensorflow.child", _C, str(tmp_path / "libtensorflow_cc.so.2")
    )
    with RuntimeProcess(_C, command) as process:
        assert process.start().endswith(" (Python)")
