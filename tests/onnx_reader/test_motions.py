"""Steps of a motion that a policy looks up in a table and clips at its end, as BeyondMimic's exporter writes them.

``torch.clamp(time_step.long().squeeze(-1), max=self.time_step_total - 1)``: a step beyond the end is the last one,
one before the beginning counts from the end in onnxruntime, and fails beyond that.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.errors import UsageError
from export_model.signatures.ids import bounds_text, check_ids
from export_model.signatures.sampling import draw_cases
from tests.onnx_reader.models import Bench, constant, floats, model, node

pytestmark = pytest.mark.xdist_group("onnx-policies")
STEPS = 40


def motion(*, least: int | None = None, last: int = STEPS - 1) -> Any:
    """A policy on its observation, and the joint positions of a motion at a step, for one row."""
    bounds = [constant("most", last, np.int64), *([] if least is None else [constant("least", least, np.int64)])]
    nodes = [
        node("MatMul", ["obs", "w"], "h"),
        node("Tanh", ["h"], "actions"),
        constant("axis", [-1], np.int64),
        node("Cast", ["time_step"], "whole", to=7),
        node("Squeeze", ["whole", "axis"], "steps"),
        *bounds,
        node("Clip", ["steps", "" if least is None else "least", "most"], "clipped"),
        node("Gather", ["motion", "clipped"], "joint_pos"),
    ]
    inputs = {"obs": (np.float32, [1, 6]), "time_step": (np.float32, [1, 1])}
    outputs = {"actions": (np.float32, [1, 3]), "joint_pos": (np.float32, [1, 3])}
    return model(nodes, inputs, outputs, {"w": floats(6, 3, scale=0.3), "motion": floats(STEPS, 3)})


def test_steps_are_drawn_from_the_table_and_beyond_its_end(bench: Bench, tmp_path: Path) -> None:
    path = bench.place(motion())
    (result,) = export([path], ExportOptions(tmp_path, verify=("onnxruntime", "tensorflow")), pool=bench.pool)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    step = result.policy.signature.inputs[1]
    assert step.distribution == {"kind": "integer", "low": 0, "high": STEPS - 1, "clipped": True}
    assert bounds_text(step) == f"an integer from 0 to {STEPS - 1}, or beyond"
    drawn = np.concatenate([c.feeds[step.name].ravel() for c in draw_cases(result.policy.signature)])
    assert {*range(STEPS)} <= {*drawn.astype(int)} and drawn.min() == 0 and drawn.max() >= STEPS
    check_ids(step, np.array([[0.0], [STEPS + 100.0]], np.float32))
    for wrong in (-1.0, 2.5):
        with pytest.raises(UsageError, match="looks it up"):
            check_ids(step, np.array([[wrong]], np.float32))


@pytest.mark.parametrize(("least", "last"), [(0, STEPS - 1), (None, STEPS - 5)])
def test_what_is_clipped_otherwise_is_no_id(least: int | None, last: int, bench: Bench, tmp_path: Path) -> None:
    """Both sides: any number may be fed. Before the end of the table: what is beyond is not told apart."""
    path = bench.place(motion(least=least, last=last))
    (result,) = export([path], ExportOptions(tmp_path, verify="none"), pool=bench.pool)
    assert result.policy.signature.inputs[1].distribution is None
