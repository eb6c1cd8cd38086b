"""The ``js`` runtime: what a model may not be is an error that names it, and the process lives on."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from converters.runtimes.pool import RuntimePool
from converters.runtimes.process import RunFailedError
from tests.runtimes.graph_models import batch, edit, node, twins, twins_by_numpy

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="Node is not on PATH")

NODES, WEIGHT = ("modelTopology", "node"), ("weightsManifest", 0, "weights", 0)


@pytest.mark.parametrize(
    ("path", "value", "why"),
    [
        (NODES, [node("out_1", "Identity", "out_2"), node("out_2", "Identity", "out_1")], "depends on itself"),
        (NODES, [node("out_1", "ReadFile"), node("out_2", "ReadFile")], "'out_2': there is no kernel for the op ReadF"),
        (NODES, [node("out_2", "Identity", "elsewhere")], "the graph has no node 'elsewhere'"),
        (NODES, None, "model.json holds no graph"),
        ((*WEIGHT, "shape"), [1 << 20], "the weights are cut off"),
        ((*WEIGHT, "quantization"), {"dtype": "float16"}, "the weights 'w1' are float16"),
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
