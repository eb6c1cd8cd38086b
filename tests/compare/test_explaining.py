"""What a wrong candidate's numbers are called: exchanged columns, units, a tanh, a clip, a scale; on both sides."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from fixtures import path as fixture
from tests.comparing import compare_artefacts

ROOT = Path(__file__).resolve().parents[2] / "fixtures"
CONTINUOUS = ROOT / "sb3/torch_actor_legacy.onnx"
MEMORY = ROOT / "torch_checkpoint/ppo_1_1_hybrid_lstm.onnx"
Edit = Callable[[onnx.ModelProto], None]


def constant(model: onnx.ModelProto, value: np.ndarray) -> str:
    name = f"planted_{len(model.graph.initializer)}"
    model.graph.initializer.append(numpy_helper.from_array(value, name))
    return name


def before_input(op: str, *operands: np.ndarray, place: int = 0, **attributes: int) -> Edit:
    """An op between an input and the graph."""

    def edit(model: onnx.ModelProto) -> None:
        graph = model.graph
        name = graph.input[place].name
        for node in graph.node:
            node.input[:] = ["planted" if i == name else i for i in node.input]
        given = [constant(model, value) for value in operands]
        graph.node.insert(0, helper.make_node(op, [name, *given], ["planted"], **attributes))

    return edit


def after_output(op: str, *operands: np.ndarray, **attributes: int) -> Edit:
    """An op between the graph and the first output."""

    def edit(model: onnx.ModelProto) -> None:
        graph = model.graph
        name = graph.output[0].name
        for node in graph.node:
            node.output[:] = ["planted" if o == name else o for o in node.output]
            node.input[:] = ["planted" if i == name else i for i in node.input]
        given = [constant(model, value) for value in operands]
        graph.node.append(helper.make_node(op, ["planted", *given], [name], **attributes))

    return edit


def other_weights(model: onnx.ModelProto) -> None:
    for weight in (t for t in model.graph.initializer if len(t.dims) == 2):
        values = np.random.default_rng(0).standard_normal(weight.dims).astype(np.float32)
        weight.CopyFrom(numpy_helper.from_array(values, weight.name))


def order(size: int, i: int, j: int) -> np.ndarray:
    places = np.arange(size)
    places[[i, j]] = j, i
    return places


def planted(source: Path, target: Path, edit: Edit) -> Path:
    model = onnx.load(source)
    edit(model)
    onnx.save(model, target)
    return target


def sentences(reference: Path, candidate: Path, pool: RuntimePool) -> list[str]:
    report = compare_artefacts(reference, candidate, runtimes="onnxruntime", pool=pool)
    named = [note for note in report.notes if " is the reference with " in note or " is the candidate with " in note]
    assert bool(named) <= (report.passed is False), "only what differs is explained"
    return named


WRONG: dict[str, tuple[Path, Edit, str]] = {
    "columns": (CONTINUOUS, before_input("Gather", order(8, 1, 3), axis=1), "state[1], state[3] exchanged"),
    "unit": (CONTINUOUS, before_input("Mul", np.float32(180 / np.pi)), "degrees"),
    "tanh": (CONTINUOUS, after_output("Tanh"), "squashed otherwise"),
    "scale": (CONTINUOUS, after_output("Mul", np.float32(0.25)), "action[0] is 0.25 ×"),
    "offset": (CONTINUOUS, after_output("Add", np.float32(0.25)), "+ 0.25"),
    "clip": (CONTINUOUS, after_output("Clip", np.float32(-0.01), np.float32(0.01)), "clipped to ±0.01"),
    "actions": (CONTINUOUS, after_output("Gather", order(2, 0, 1), axis=1), "action[0], action[1] exchanged"),
    "memory": (MEMORY, before_input("Gather", order(5, 1, 3), axis=1), "state[1], state[3] exchanged"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_difference_is_called_what_it_is(name: str, tmp_path: Path, pool: RuntimePool) -> None:
    source, edit, words = WRONG[name]
    (sentence,) = sentences(source, planted(source, tmp_path / "wrong.onnx", edit), pool)
    assert words in sentence


@pytest.mark.parametrize("right", [False, True])
def test_an_image_upside_down_is_called_so(tmp_path: Path, pool: RuntimePool, right: bool) -> None:
    (result,) = export([fixture("visual")], ExportOptions(tmp_path, targets=("onnx",), verify="none"))
    own = result.folder / "visual.onnx"
    height = onnx.load(own).graph.input[1].type.tensor_type.shape.dim[1].dim_value
    wrong = planted(
        own, tmp_path / "wrong.onnx", before_input("Gather", np.arange(height)[::-1].copy(), place=1, axis=1)
    )
    named = sentences(own, own if right else wrong, pool)
    assert [("upside down" in sentence) for sentence in named] == ([] if right else [True])


def test_an_image_and_other_weights_have_no_name(tmp_path: Path, pool: RuntimePool) -> None:
    (result,) = export([fixture("visual")], ExportOptions(tmp_path, targets=("onnx",), verify="none"))
    own = result.folder / "visual.onnx"
    assert sentences(own, planted(own, tmp_path / "other.onnx", other_weights), pool) == []


def test_what_nothing_explains_has_no_name(tmp_path: Path, pool: RuntimePool) -> None:
    assert sentences(CONTINUOUS, planted(CONTINUOUS, tmp_path / "other.onnx", other_weights), pool) == []


def test_the_same_policy_is_not_explained(pool: RuntimePool) -> None:
    assert sentences(CONTINUOUS, CONTINUOUS, pool) == []
