"""The ``js`` runtime: what a model may not be is an error that names it, and the process lives on."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from converters.files.children.process import RunFailedError
from converters.runtimes.pool import RuntimePool
from tests.runtimes.graph_models import batch, edit, info, node, twins, twins_by_numpy, write_model

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="Node is not on PATH")

NODES, WEIGHT = ("modelTopology", "node"), ("weightsManifest", 0, "weights", 0)


@pytest.mark.parametrize(
    ("path", "value", "why"),
    [
        (NODES, [node("out_1", "Identity", "out_2"), node("out_2", "Identity", "out_1")], "depends on itself"),
        (NODES, [node("out_1", "ReadFile"), node("out_2", "ReadFile")], "'out_2': no kernel for the op ReadF"),
        (NODES, [node("out_2", "Identity", "elsewhere")], "the graph has no node 'elsewhere'"),
        (NODES, None, "model.json holds no graph"),
        ((*WEIGHT, "shape"), [1 << 20], "the weights are cut off"),
        ((*WEIGHT, "quantization"), {"dtype": "uint4"}, "the weights 'w1' are uint4"),
    ],
)
def test_what_is_no_model_of_ours_is_refused(
    path: tuple[Any, ...], value: Any, why: str, tmp_path: Path, processes: RuntimePool
) -> None:
    broken = twins(tmp_path / "broken")
    edit(broken, *path, value=value)
    process = processes.process("js")
    with pytest.raises(RunFailedError, match=why):
        process.load(str(broken))
    model = process.load(str(twins(tmp_path / "whole")))
    with pytest.raises(RunFailedError, match="has no value"):
        model.predict({}, [])
    answers = model.predict(batch(2), [])
    model.unload()
    for name, wanted in twins_by_numpy(**batch(2)).items():
        np.testing.assert_allclose(answers[name], wanted, atol=1e-6)


@pytest.mark.parametrize(
    ("op", "inputs"),
    [
        ("BroadcastTo", {"x": np.zeros(1, np.float32), "shape": np.array([1 << 15, 1 << 15], np.int32)}),
        ("Tile", {"x": np.zeros(1, np.float32), "times": np.array([(1 << 31) - 1], np.int32)}),
        ("Transpose", {"x": np.zeros(1 << 10, np.float32), "order": np.zeros(4, np.int32)}),
        (
            "OneHot",
            {
                "x": np.zeros(1, np.int32), "depth": np.array((1 << 31) - 1, np.int32),
                "on": np.array(1, np.float32), "off": np.array(0, np.float32),
            },
        ),
    ],
)  # fmt: skip
def test_what_is_larger_than_any_tensor_is_refused_before_it_is_made(
    op: str, inputs: dict[str, np.ndarray], tmp_path: Path, processes: RuntimePool
) -> None:
    nodes = [node("big", op, *inputs), node("out", "Identity", "big")]
    folder = write_model(tmp_path / "m", nodes, inputs, {}, {"y": info("out:0", "float32", [None])})
    with pytest.raises(RunFailedError, match="no tensor has the shape"):
        processes.process("js").load(str(folder)).predict({}, [])
