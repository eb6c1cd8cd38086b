"""Observations of several axes that are no cameras: histories of a fixed length, boards of games in small integers.

The oracle is onnxruntime on the file itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.roles import Role
from tests.onnx_reader.models import Bench, floats, model, node, save

pytestmark = pytest.mark.xdist_group("onnx-policies")


def network(sizes: Sequence[int], dtype: npt.DTypeLike = np.float32, name: str = "obs") -> Any:
    cast = np.dtype(dtype).kind != "f"
    nodes = [node("Cast", [name], "numbers", to=1)] if cast else []
    nodes += [
        node("Flatten", ["numbers" if cast else name], "flat", axis=1), node("MatMul", ["flat", "w"], "h"),
        node("Tanh", ["h"], "action"),
    ]  # fmt: skip
    weights = {"w": floats(math.prod(sizes), 3, scale=0.2)}
    return model(nodes, {name: (dtype, ["batch", *sizes])}, {"action": (np.float32, ["batch", 3])}, weights)


def compiled(message: Any, folder: Path, **options: Any) -> Policy:
    (policy,) = read_source(save(message, folder)).policies(CompileOptions(**options))
    return policy


@pytest.mark.parametrize(
    ("sizes", "dtype", "name"),
    [
        ((6, 5), np.float32, "history"),
        ((6, 7), np.int8, "obs"),
        ((6, 7, 2), np.float32, "obs"),
        ((8, 8, 2), np.int8, "board"),
        ((119, 8, 8), np.float32, "input"),
        ((19, 19, 17), np.uint8, "obs"),
        ((7, 7, 3), np.uint8, "observation"),
        ((42,), np.int16, "obs"),
        ((4, 6, 7, 2), np.float32, "obs"),
    ],
)
def test_boards_and_histories_are_fed_as_they_are(
    sizes: tuple[int, ...], dtype: Any, name: str, bench: Bench, tmp_path: Path
) -> None:
    path = bench.place(network(sizes, dtype, name))
    wanted = ("onnxruntime", "tfjs-cpu") if sizes in ((6, 7), (8, 8, 2)) else ("onnxruntime",)
    (result,) = export([path], ExportOptions(tmp_path, verify=wanted), pool=bench.pool)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    (spec,) = result.policy.signature.inputs
    assert (spec.name, spec.role, spec.shape) == ("state", Role.VECTOR, (None, *sizes))
    assert not result.policy.signature.preprocess
    kind = np.dtype(dtype)
    assert spec.dtype == ("int32" if kind.kind in "iu" else "float32")
    if kind.kind in "iu":
        limits = np.iinfo(kind)
        known = spec.distribution or {}
        assert (known["low"], known["high"]) == (limits.min, limits.max)


@pytest.mark.parametrize(
    ("sizes", "name"), [((3, 84, 84), "obs"), ((20, 20, 3), "obs"), ((12, 12, 3), "camera"), ((5, 5, 4), "obs_0")]
)
def test_cameras_stay_cameras(sizes: tuple[int, ...], name: str, tmp_path: Path) -> None:
    (spec,) = compiled(network(sizes, name=name), tmp_path).signature.inputs
    assert (spec.name, spec.role) == ("observation_0", Role.VISUAL)


def test_the_user_and_mlagents_may_say_that_it_is_a_list_or_a_camera(tmp_path: Path) -> None:
    assert compiled(network((6, 5), name="obs_0"), tmp_path).signature.inputs[0].role is Role.ENTITIES
    for role in (Role.ENTITIES, Role.VISUAL):
        sizes = (6, 5) if role is Role.ENTITIES else (6, 7, 2)
        assert compiled(network(sizes), tmp_path, inputs={"obs": role}).signature.inputs[0].role is role


@pytest.mark.parametrize("index", ["id", "row", "rest"])
def test_ids_are_those_of_the_table(index: str, bench: Bench, tmp_path: Path) -> None:
    """ONNX's Gather counts an id below 0 from the end; Keras 3 and PyTorch may add the length before it, too.

    Where the model itself looks up a remainder, any integer may be fed.
    """
    nodes = [
        node("Less", ["id", "none"], "below"), node("Add", ["id", "rows"], "from_end"),
        node("Where", ["below", "from_end", "id"], "row"),
        node("Mod", ["id", "rows"], "rest"),
        node("Gather", ["table", index], "found"), node("Flatten", ["found"], "flat", axis=1),
        node("MatMul", ["flat", "w"], "h"), node("Tanh", ["h"], "action"),
    ]  # fmt: skip
    weights = {"none": np.array(0), "rows": np.array(10), "table": floats(10, 4), "w": floats(12, 2)}
    fed, given = {"id": (np.int64, ["batch", 3])}, {"action": (np.float32, ["batch", 2])}
    path = bench.place(model(nodes, fed, given, weights))
    (result,) = export([path], ExportOptions(tmp_path, verify=("onnxruntime",)), pool=bench.pool)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    known = {"kind": "integer", "low": 0, "high": 9}
    assert result.policy.signature.inputs[0].distribution == (None if index == "rest" else known)
