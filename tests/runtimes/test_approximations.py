"""How far each runtime is from the functions it approximates: no farther than what the op table says of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from export_model.converters.formats.registry import DEFAULTS, WRITTEN
from export_model.converters.graph.ops.approximations import APPROXIMATIONS, RANGES
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import RUNTIMES, available_runtimes
from export_model.converters.runtimes.tensorflow.release import RELEASES
from export_model.exporter.export.pipeline import ExportOptions, export
from tests.handmade import constant, graph_bytes, node, placeholder
from tests.legacy.installed import ensure

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("runtimes")]

Array = npt.NDArray[Any]
#: One argument, as a column of its own; softmaxes take all columns.
EXACT: Mapping[str, Callable[[Array], Array]] = {
    "Cos": np.cos,
    "Elu": lambda x: np.where(x > 0, x, np.expm1(x)),
    "Erf": np.vectorize(math.erf),
    "Exp": np.exp,
    "Expm1": np.expm1,
    "Log": np.log,
    "Log1p": np.log1p,
    "LogSoftmax": lambda x: x - x.max(1, keepdims=True) - np.log(np.exp(x - x.max(1, keepdims=True)).sum(1))[:, None],
    "Rsqrt": lambda x: 1 / np.sqrt(x),
    "Selu": lambda x: 1.0507009873554805 * np.where(x > 0, x, 1.6732632423543772 * np.expm1(x)),
    "Sigmoid": lambda x: 1 / (1 + np.exp(-x)),
    "Sin": np.sin,
    "Softmax": lambda x: np.exp(x - x.max(1, keepdims=True)) / np.exp(x - x.max(1, keepdims=True)).sum(1)[:, None],
    "Softplus": lambda x: np.logaddexp(0, x),
    "Sqrt": np.sqrt,
    "Tanh": np.tanh,
}
POSITIVE = ("Log", "Log1p", "Rsqrt", "Sqrt")


def arguments() -> Array:
    rng = np.random.default_rng(0)
    sizes = 10.0 ** rng.uniform(-6, 1.48, (4000, 3))
    return np.concatenate([rng.uniform(-20, 20, (4000, 3)), rng.choice([-1, 1], (4000, 3)) * sizes]).astype(np.float32)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All functions side by side: one load measures them all."""
    nodes = [placeholder("vector_observation"), node("positive", "Abs", "vector_observation", T=np.float32)]
    nodes += [node(op, op, "positive" if op in POSITIVE else "vector_observation", T=np.float32) for op in EXACT]
    nodes += [
        constant("axis", 1),
        node("action", "ConcatV2", *EXACT, "axis", N=len(EXACT), T=np.float32, Tidx=np.int32),
    ]
    place = tmp_path_factory.mktemp("functions")
    (place / "functions.bytes").write_bytes(graph_bytes(nodes))
    (result,) = export([place / "functions.bytes"], ExportOptions(place / "out", (*DEFAULTS, "litert"), verify="none"))
    return result.folder


def artefacts(bundle: Path) -> Iterator[tuple[str, str, Path]]:
    """(format, runtime, path): each runtime once, but litert-web: no free batch, and the kernels of litert."""
    installed = {r.name for r in available_runtimes() if r.installed}
    for runtime in RUNTIMES:
        key = next((k for k in ("bytes", "onnx", "tfjs", "litert") if runtime.name in WRITTEN[k].runtimes), None)
        if (
            runtime.independent
            and key is not None
            and runtime.name in installed
            and "@" not in runtime.name
            and not runtime.fixed
        ):
            yield key, runtime.name, bundle / WRITTEN[key].main_of("functions")


def test_no_runtime_is_farther_off_than_the_table_says_and_some_runtime_nearly_is(
    bundle: Path, processes: RuntimePool
) -> None:
    for release in RELEASES:  # they are the farthest off, and in a fresh environment no other test may have asked yet
        ensure(release)
    values = arguments()
    kinds = {r.name: r.arithmetic for r in RUNTIMES}
    wrong: list[tuple[str, str, float, float, float]] = []
    worst = dict.fromkeys(EXACT, 0.0)
    for key, runtime, path in artefacts(bundle):
        model = processes.process(runtime).load(str(path), **WRITTEN[key].loader())
        columns = np.split(model.run({"state": values}, ["action"])["action"], len(EXACT), axis=1)
        model.unload()
        for (op, function), column in zip(EXACT.items(), columns, strict=True):
            wanted = function((np.abs(values) if op in POSITIVE else values).astype(np.float64))
            step = np.spacing(np.abs(wanted).astype(np.float32)).astype(np.float64)
            ulps, absolute = APPROXIMATIONS[kinds[runtime]][op]
            off = np.abs(column - wanted)
            share = float((off / np.maximum(ulps * step, absolute)).max())
            low, high = RANGES.get(op, (-np.inf, np.inf))
            if share > 1 or column.min() < low or column.max() > high:
                wrong.append((op, runtime, float((off / step).max()), float(column.min()), float(column.max())))
            if kinds[runtime] == "processor":
                worst[op] = max(worst[op], share)
    assert wrong == []
    # ... and what it says is not made up.
    assert {op: share for op, share in worst.items() if share < 0.5} == {}
