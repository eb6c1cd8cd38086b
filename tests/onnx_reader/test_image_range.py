"""Whether a policy divides the colours of an image by 255 itself, as other trainers' do, and what is then said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.inspect.inspection import inspect_source, inspection_text
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.sampling import draw_cases
from fixtures import path as fixture
from tests.onnx_reader.models import Array, Bench, constant, model, node, save

pytestmark = pytest.mark.xdist_group("onnx-policies")

SIDE = 24  # the least that is taken for a camera is 20
WEIGHTS = {
    "kernel": np.random.default_rng(1).standard_normal((4, 3, 3, 3)).astype(np.float32),
    "head": np.random.default_rng(2).standard_normal((4 * (SIDE - 2) ** 2, 2)).astype(np.float32),
}


def cnn(first: list[Any], scaled: str = "scaled") -> Any:
    """obs → first → a convolution → actions, as torch.onnx.export writes Stable-Baselines3's NatureCNN."""
    nodes = [
        *first,
        node("Conv", [scaled, "kernel"], "seen"),
        node("Relu", ["seen"], "rectified"),
        node("Flatten", ["rectified"], "flat"),
        node("MatMul", ["flat", "head"], "actions"),
    ]
    return model(nodes, {"obs": (np.float32, ["batch", 3, SIDE, SIDE])}, ["actions"], WEIGHTS)


def divided(kind: str, value: Any, *, turned: bool = False) -> list[Any]:
    operands = ["number", "obs"] if turned else ["obs", "number"]
    return [constant("number", value), node(kind, operands, "scaled")]


CASES: dict[str, tuple[list[Any], int]] = {
    "by 255": (divided("Div", 255.0), 255),
    "times 1/255": (divided("Mul", np.float32(1) / np.float32(255)), 255),
    "1/255 times": (divided("Mul", np.float32(1) / np.float32(255), turned=True), 255),
    "a divisor for each colour": (divided("Div", np.full((1, 3, 1, 1), 255.0)), 255),
    "behind what passes it on": (
        [constant("number", 255.0), node("Identity", ["obs"], "same"), node("Div", ["same", "number"], "scaled")],
        255,
    ),
    "not at all": ([node("Identity", ["obs"], "scaled")], 1),
    "by another number": (divided("Div", 128.0), 1),
    "255 by the image": (divided("Div", 255.0, turned=True), 1),
    "times 255": (divided("Mul", 255.0), 1),
    "once divided and once not": (
        [constant("number", 255.0), node("Div", ["obs", "number"], "part"), node("Add", ["part", "obs"], "scaled")],
        1,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_the_range_is_what_the_graph_takes(name: str, tmp_path: Path) -> None:
    first, highest = CASES[name]
    place = save(cnn(first), tmp_path)
    (policy,) = read_source(place).policies()
    (spec,) = policy.signature.inputs
    told = policy.signature.preprocess[spec.name]
    assert told["range"] == [0, highest]
    assert ("as they are" in told["from_bytes"]) == (highest == 255)
    assert spec.distribution == {"kind": "uniform", "low": 0.0, "high": float(highest)}
    typical = next(c for c in draw_cases(policy.signature) if c.name.startswith("typical, batch 7"))
    image: Array = typical.feeds[spec.name]
    assert highest / 2 < image.max() <= highest
    text = inspection_text(inspect_source(place))
    assert ("colours from 0 to 255" in text) == (highest == 255)


def test_it_is_kept_in_what_is_written_and_agrees_with_the_source(bench: Bench, tmp_path: Path) -> None:
    place = bench.place(cnn(CASES["by 255"][0]))
    (result,) = export([place], ExportOptions(tmp_path, verify=("onnxruntime",)), pool=bench.pool)
    assert result.report is not None
    assert result.report.reference == "source/onnxruntime"
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    for form in (f"{result.policy.name}.bytes", "saved_model", "tfjs", f"{result.policy.name}.onnx"):
        (again,) = read_source(result.folder / form).policies()
        assert again.signature.preprocess == result.policy.signature.preprocess


def test_images_of_unity_are_0_to_1() -> None:
    (policy,) = read_source(fixture("visual")).policies()
    assert [p["range"] for p in policy.signature.preprocess.values()] == [[0, 1]]
