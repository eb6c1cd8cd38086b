"""Faults in what a file does with its draws, that show at some inputs alone or are small: drawn outputs are numbers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.again import verify_folder
from export_model.exporter.export.options import ExportOptions
from export_model.exporter.export.pipeline import export
from export_model.exporter.verify.report import ParityReport
from fixtures import path as fixture
from tests.comparing import compare_artefacts
from tests.faults.artefacts import opened
from tests.handmade import constant, dense, graph_bytes, placeholder
from tests.handmade import node as made_node

DEMO = Path("exporter/demo")
Plant = Callable[[onnx.GraphProto, str], None]


def add(graph: onnx.GraphProto, before: str | None, *nodes: onnx.NodeProto) -> None:
    """Put nodes before the one that makes ``before``, at the end without."""
    made = [i for i, n in enumerate(graph.node) if before in n.output]
    for number, node in enumerate(nodes):
        graph.node.insert((made[0] if made else len(graph.node)) + number, node)


def constant_of(graph: onnx.GraphProto, name: str, value: Any) -> str:
    graph.initializer.append(numpy_helper.from_array(np.asarray(value), name))
    return name


def replaced(graph: onnx.GraphProto, tensor: str) -> str:
    """Let a tensor have another name where it is made, so that what is planted can have its own."""
    for node in graph.node:
        for i, name in enumerate(node.output):
            if name == tensor:
                node.output[i] = f"{tensor}/right"
                return f"{tensor}/right"
    raise AssertionError(tensor)


def where(graph: onnx.GraphProto) -> list[onnx.NodeProto]:
    """Nodes that make ``planted/where`` [B, 1]: the first number that is observed is above 0.2."""
    observed = graph.input[0].name
    starts, ends, axes = (
        constant_of(graph, f"planted/{n}", np.array([v], np.int64)) for n, v in zip("sea", (0, 1, 1), strict=True)
    )
    limit = constant_of(graph, "planted/limit", np.float32(0.2))
    return [
        helper.make_node("Slice", [observed, starts, ends, axes], ["planted/first"]),
        helper.make_node("Greater", ["planted/first", limit], ["planted/where"]),
    ]


def sampler(graph: onnx.GraphProto, number: int = 0) -> onnx.NodeProto:
    return [n for n in graph.node if "Random" in n.op_type or n.op_type == "Multinomial"][number]


def shifted(graph: onnx.GraphProto, action: str) -> None:
    """+5 where obs[0] > 0.2."""
    right, five = replaced(graph, action), constant_of(graph, "planted/five", np.float32(5))
    add(
        graph,
        None,
        *where(graph),
        helper.make_node("Add", [right, five], ["planted/more"]),
        helper.make_node("Where", ["planted/where", "planted/more", right], [action]),
    )


def without_chance(graph: onnx.GraphProto, action: str) -> None:
    """No noise where obs[0] > 0.2."""
    drawn = sampler(graph).output[0]
    right = replaced(graph, drawn)
    place = next(i for i, n in enumerate(graph.node) if right in n.output) + 1
    made = [*where(graph), helper.make_node("Sub", [right, right], ["planted/none"])]
    made.append(helper.make_node("Where", ["planted/where", "planted/none", right], [drawn]))
    for number, node in enumerate(made):
        graph.node.insert(place + number, node)


def unclamped(graph: onnx.GraphProto, action: str) -> None:
    """The clamp is left out of the action, and of it alone."""
    made = {name: n for n in graph.node for name in n.output}
    drawn = sampler(graph).output[0]
    readers = [n for n in graph.node if drawn in n.input]
    for node in graph.node:
        if node.op_type in ("Min", "Max", "Clip") and any(_reads(made, i, readers) for i in node.input[:1]):
            for other in graph.node:
                other.input[:] = [node.input[0] if i == node.output[0] else i for i in other.input]


def _reads(made: dict[str, onnx.NodeProto], tensor: str, goals: list[onnx.NodeProto]) -> bool:
    node = made.get(tensor)
    return node is not None and (node in goals or any(_reads(made, i, goals) for i in node.input))


def louder(graph: onnx.GraphProto, action: str) -> None:
    """Noise × 1.15."""
    drawn = sampler(graph).output[0]
    right, more = replaced(graph, drawn), constant_of(graph, "planted/more", np.float32(1.15))
    place = next(i for i, n in enumerate(graph.node) if right in n.output) + 1
    graph.node.insert(place, helper.make_node("Mul", [right, more], [drawn]))


def louder_by_attribute(graph: onnx.GraphProto, action: str) -> None:
    """Noise × 1.15, as the sampler says."""
    sampler(graph).attribute.append(helper.make_attribute("scale", 1.15))


def mean_of_the_first(graph: onnx.GraphProto, action: str) -> None:
    """Every agent acts on the first one's observation."""
    observed, first = graph.input[0].name, constant_of(graph, "planted/first", np.array([0], np.int64))
    for node in graph.node:
        node.input[:] = ["planted/row" if i == observed else i for i in node.input]
    made = [
        helper.make_node("Gather", [observed, first], ["planted/one"], axis=0),
        helper.make_node("Sub", [observed, observed], ["planted/nothing"]),
        helper.make_node("Add", ["planted/nothing", "planted/one"], ["planted/row"]),
    ]
    for number, node in enumerate(made):
        graph.node.insert(number, node)


def times_zero(graph: onnx.GraphProto, action: str) -> None:
    """Class 0, whatever was drawn."""
    right = replaced(graph, action)
    add(graph, None, helper.make_node("Sub", [right, right], [action]))


def odds_of_the_first(graph: onnx.GraphProto, action: str) -> None:
    """One sampler draws for all rows by the odds of the first."""
    node, first = sampler(graph), constant_of(graph, "planted/first", np.array([0], np.int64))
    scores = node.input[0]
    add(
        graph,
        node.output[0],
        helper.make_node("Gather", [scores, first], ["planted/one"], axis=0),
        helper.make_node("Sub", [scores, scores], ["planted/nothing"]),
        helper.make_node("Add", ["planted/nothing", "planted/one"], ["planted/row"]),
    )
    node.input[0] = "planted/row"


def hotter(graph: onnx.GraphProto, action: str) -> None:
    """Temperature × 1.2, of the last branch."""
    node, less = sampler(graph, -1), constant_of(graph, "planted/less", np.float32(1 / 1.2))
    add(graph, node.output[0], helper.make_node("Mul", [node.input[0], less], ["planted/hotter"]))
    node.input[0] = "planted/hotter"


def random_at_times(graph: onnx.GraphProto, action: str) -> None:
    """The first class in one row of fifty."""
    right, rare = replaced(graph, action), constant_of(graph, "planted/rare", np.float32(0.02))
    observed = graph.input[0].name
    starts, ends, axes = (
        constant_of(graph, f"planted/{n}", np.array([v], np.int64)) for n, v in zip("sea", (0, 1, 1), strict=True)
    )
    add(
        graph,
        None,
        helper.make_node("Slice", [observed, starts, ends, axes], ["planted/column"]),
        helper.make_node("RandomUniformLike", ["planted/column"], ["planted/chance"]),
        helper.make_node("Less", ["planted/chance", rare], ["planted/where"]),
        helper.make_node("Sub", [right, right], ["planted/zero"]),
        helper.make_node("Where", ["planted/where", "planted/zero", right], [action]),
    )


NUMBERS = (shifted, without_chance, unclamped, louder, louder_by_attribute, mean_of_the_first)
CLASSES = (times_zero, odds_of_the_first, hotter, random_at_times)


def plant(folder: Path, fault: Plant, action: str) -> Path:
    """Plant a fault into a bundle's .onnx, as if it had been exported so; give the file."""
    artefact = opened("onnx", folder)
    fault(artefact.model.graph, action)  # type: ignore[attr-defined]
    artefact.save()
    return next(folder.glob("*.onnx"))


def caught(report: ParityReport, output: str) -> bool:
    return report.passed is False and output in {f.output for f in report.failures if f.runtime == "onnxruntime"}


@pytest.mark.parametrize("fault", NUMBERS)
def test_drawn_numbers_that_unity_plays(fault: Plant, tmp_path: Path) -> None:
    source = DEMO / "3DBall.bytes"
    (result,) = export([source], ExportOptions(tmp_path, profile="unity6", verify="none"))
    plant(result.folder, fault, "continuous_actions")
    report = verify_folder(result.folder, source=source, runtimes="onnxruntime")
    assert caught(report, "continuous_actions"), report.comparisons


@pytest.mark.parametrize("fault", CLASSES)
@pytest.mark.parametrize(("source", "profile"), [("sampled", "barracuda-3"), ("recurrent", "unity6")])
def test_drawn_classes_that_unity_plays(fault: Plant, source: str, profile: str, tmp_path: Path) -> None:
    (result,) = export([fixture(source)], ExportOptions(tmp_path, profile=profile, verify="none"))
    plant(result.folder, fault, "discrete_actions")
    report = verify_folder(result.folder, source=fixture(source), runtimes="onnxruntime")
    assert caught(report, "discrete_actions"), report.comparisons


@pytest.mark.parametrize("fault", NUMBERS)
def test_noise_that_is_kept_or_of_a_candidate_of_its_own(fault: Plant, tmp_path: Path, pool: RuntimePool) -> None:
    source = DEMO / "3DBall.pt"
    options = ExportOptions(tmp_path, targets=("onnx",), compile=CompileOptions(noise="keep"), verify="none")
    (result,) = export([source], options)
    file = next(result.folder.glob("*.onnx"))
    assert compare_artefacts(source, [file], runtimes="onnxruntime", pool=pool).passed is True
    plant(result.folder, fault, "action")
    assert caught(verify_folder(result.folder, source=source, runtimes="onnxruntime"), "action")
    report = compare_artefacts(source, [file], runtimes="onnxruntime", pool=pool)
    assert caught(report, "action"), report.comparisons


@pytest.fixture(scope="module")
def two_branches(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that draws one of four classes, gives its log-probability, and has a second branch of one action."""
    nodes = [
        placeholder("vector_observation"),
        *dense("logits", "vector_observation", 3, 4),
        *dense("only", "vector_observation", 3, 1),
        constant("count", 1),
        made_node("log_probs", "LogSoftmax", "logits"),
        made_node("first", "Multinomial", "log_probs", "count", output_dtype=np.int64),
        made_node("second", "Multinomial", "only", "count", output_dtype=np.int64),
        constant("axis", 1),
        made_node("action", "ConcatV2", "first", "second", "axis", N=2),
        *(constant(n, np.array(v)) for n, v in (("depth", 4), ("on", np.float32(1)), ("off", np.float32(0)))),
        *(constant("all", np.array([-1], np.int32)), made_node("flat", "Reshape", "first", "all")),
        made_node("chosen", "OneHot", "flat", "depth", "on", "off", axis=-1),
        made_node("each", "Mul", "log_probs", "chosen"),
        made_node("action_log_prob", "Sum", "each", "axis", keep_dims=True),
    ]
    file = tmp_path_factory.mktemp("branches") / "branches.bytes"
    file.write_bytes(graph_bytes(nodes))
    return file


def second_column(graph: onnx.GraphProto, action: str) -> None:
    """Class 1 of a branch that has one."""
    right, more = replaced(graph, action), constant_of(graph, "planted/more", np.array([0, 1], np.int64))
    add(graph, None, helper.make_node("Add", [right, more], [action]))


@pytest.mark.parametrize(
    ("fault", "output"), [(second_column, "action"), (shifted, "action_log_prob"), (hotter, "action")]
)
def test_what_follows_from_a_class(fault: Plant, output: str, two_branches: Path, tmp_path: Path) -> None:
    compiled = CompileOptions(outputs={"action": "action", "action_log_prob": "log_prob"})
    options = ExportOptions(tmp_path, targets=("onnx",), compile=compiled, verify="none")
    (result,) = export([two_branches], options)
    honest = verify_folder(result.folder, source=two_branches, runtimes="onnxruntime")
    assert honest.passed is True, honest.failures
    plant(result.folder, fault, output)
    report = verify_folder(result.folder, source=two_branches, runtimes="onnxruntime")
    assert caught(report, output), report.comparisons
