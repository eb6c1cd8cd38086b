"""Every op with ``--math own``: the same bits in C, C# and JavaScript, extremes and draws included."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.nodes import TensorShape
from export_model.converters.graph.ops.table import TABLE
from export_model.converters.graph.types import FLOAT32
from export_model.converters.runtimes.pool import RuntimePool
from export_model.signatures.code import CodeOptions
from export_model.signatures.errors import UnsupportedOpError
from tests.graph.harness import Array, Runtimes, policy_of
from tests.graph.samples import Sample
from tests.graph.test_ops import BY_OP, computed

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("programs")]

OWN_MATH = CodeOptions(math="own")
OPS = [op for op, entry in TABLE.items() if op in BY_OP and entry.older is None and entry.loops is not None]


def bits(array: Array) -> Array:
    """Floats as integers; one for every NaN, whose bits are of the processor."""
    if array.dtype != FLOAT32:
        return array
    return np.where(np.isnan(array), np.float32(np.nan), array).view(np.int32)


def runs(sample: Sample, runtimes: Runtimes, key: str) -> list[Array] | None:
    graph = sample.with_shapes(lambda _, array: TensorShape(array.shape))
    try:
        return runtimes.program(key, policy_of(graph, sample.fetches), sample.feeds, OWN_MATH)
    except UnsupportedOpError:
        return None  # tests/graph/test_ops.py says which


@pytest.fixture(scope="module")
def of_c() -> dict[int, list[Array] | None]:
    """Sample's identity → what its header answers: compiled once for all languages."""
    return {}


@pytest.mark.parametrize("key", [key for key, form in WRITTEN.items() if form.program and key != "c"])
@pytest.mark.parametrize("op", OPS)
def test_bits_are_those_of_c(
    op: str, key: str, of_c: dict[int, list[Array] | None], processes: RuntimePool, tmp_path: Path
) -> None:
    runtimes = Runtimes(processes, tmp_path)
    runtimes.need(WRITTEN[key].runtimes[0])
    runtimes.need("c")
    found = []
    for sample in BY_OP[op]:
        if any(0 in array.shape or not array.shape for array in computed(sample)):
            continue  # no contract has such an output
        if id(sample) not in of_c:
            of_c[id(sample)] = runs(sample, runtimes, "c")
        expected, given = of_c[id(sample)], runs(sample, runtimes, key)
        if expected is None or given is None:
            assert expected is None and given is None
            continue
        for a, b in zip(expected, given, strict=True):
            if not np.array_equal(bits(a), bits(b)):
                found.append(f"{sample.title}: {a.reshape(-1)[:6]} and {b.reshape(-1)[:6]}")
    assert found == []
