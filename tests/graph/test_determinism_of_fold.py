"""What is folded is the float64 result, rounded once: the same bytes on every processor."""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.compiler.passes.fold import fold
from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.frozen_graph.encode import encode
from export_model.converters.graph.nodes import Graph
from tests.graph.making import const, graph, node, ops

ROOT = Path(__file__).resolve().parents[2]

#: Python's own functions, which use the C library and no vector instructions.
FUNCTIONS: Mapping[str, Callable[[float], float]] = {
    "Exp": math.exp,
    "Expm1": math.expm1,
    "Log": math.log,
    "Log1p": math.log1p,
    "Sqrt": math.sqrt,
    "Rsqrt": lambda x: 1 / math.sqrt(x),
    "Sin": math.sin,
    "Cos": math.cos,
    "Tan": math.tan,
    "Tanh": math.tanh,
    "Erf": math.erf,
    "Sigmoid": lambda x: 1 / (1 + math.exp(-x)),
    "Softplus": lambda x: x + math.log1p(math.exp(-x)),
}
VALUES = np.random.default_rng(0).uniform(0.01, 12, 3000).astype(np.float32)


@pytest.mark.parametrize("op", FUNCTIONS)
def test_folding_rounds_the_float64_result_once(op: str) -> None:
    made = fold(graph(const("x", VALUES), node("y", op, "x")))
    exact = np.array([FUNCTIONS[op](float(x)) for x in VALUES]).astype(np.float32)
    assert made["y"].op == "Const"
    np.testing.assert_array_equal(made["y"].value, exact, strict=True)


def test_powers_and_means_are_rounded_once_too() -> None:
    rows = VALUES.reshape(300, 10)
    made = fold(
        graph(
            const("x", rows),
            const("two", np.array(1.7, np.float32)),
            const("axis", 1),
            node("power", "Pow", "x", "two"),
            node("mean", "Mean", "x", "axis"),
            node("softmax", "Softmax", "x"),
        )
    )
    exponent = float(np.float32(1.7))
    exact = np.array([[float(x) ** exponent for x in row] for row in rows]).astype(np.float32)
    np.testing.assert_array_equal(made["power"].value, exact, strict=True)
    exact = np.array([math.fsum(map(float, row)) / 10 for row in rows]).astype(np.float32)
    np.testing.assert_array_equal(made["mean"].value, exact, strict=True)
    e = np.array([[math.exp(float(x) - float(max(row))) for x in row] for row in rows])
    exact = np.array([row / math.fsum(row) for row in e]).astype(np.float32)
    np.testing.assert_array_equal(made["softmax"].value, exact, strict=True)


# ------------------------------------------------------------------ other processors


def everything() -> Graph:
    """Constants through every function, and a product that must stay one."""
    return graph(
        const("x", VALUES),
        *(node(op, op, "x") for op in FUNCTIONS),
        const("a", VALUES.reshape(30, 100)),
        const("b", VALUES.reshape(100, 30)),
        node("product", "MatMul", "a", "b"),
    )


def digest() -> str:
    """Of the folded graph, as it would be written."""
    made = fold(everything())
    assert ops(made) == ["MatMul"]
    return hashlib.sha256(schema.serialise(encode(made))).hexdigest()


def vector_instructions() -> list[str]:
    """What numpy uses of this processor beyond its baseline."""
    from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

    return [name for name in __cpu_dispatch__ if __cpu_features__.get(name)]


def test_the_bytes_do_not_depend_on_the_processor() -> None:
    features = vector_instructions()
    if not features:
        pytest.skip("this processor has nothing that numpy could leave unused")
    environment = {**os.environ, "NPY_DISABLE_CPU_FEATURES": " ".join(features)}
    code = (
        "from tests.graph.test_determinism_of_fold import digest, vector_instructions\n"
        "assert vector_instructions() == []\n"
        "print(digest())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, encoding="utf-8", check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == digest()
