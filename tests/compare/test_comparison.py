"""Artefacts held against a reference: what agrees, what is called otherwise, what is missing, what differs."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.format import Ports
from export_model.converters.formats.frozen_graph.tensors import from_array, to_array
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.compare.matching import Artefact, labels_of
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.verify.findings import Finding
from export_model.exporter.verify.report import ParityReport
from export_model.signatures.errors import RuntimeUnavailableError, UsageError
from fixtures import path as fixture
from tests.commands import export_model, is_refused
from tests.comparing import compare_artefacts

RUNTIMES = "tensorflow,onnxruntime,tfjs-cpu"


@pytest.fixture(scope="module")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    out = tmp_path_factory.mktemp("bundles")

    def of(name: str) -> Path:
        if not (out / name).exists():
            list(export([fixture(name)], ExportOptions(out, verify="none")))
        return out / name

    return of


Bundles = Callable[[str], Path]


def edited(source: Path, target: Path, edit: Callable[[onnx.ModelProto], None]) -> Path:
    model = onnx.load(source)
    edit(model)
    onnx.save(model, target)
    return target


def renamed(model: onnx.ModelProto, old: str, new: str) -> None:
    for node in model.graph.node:
        for names in (node.input, node.output):
            names[:] = [new if n == old else n for n in names]
    for value in (*model.graph.input, *model.graph.output):
        value.name = new if value.name == old else value.name


def only_failure(report: ParityReport) -> Finding:
    assert report.passed is False
    (failure,) = report.failures
    return failure


@pytest.mark.parametrize("name", ["continuous", "discrete", "sampled", "recurrent", "visual"])
def test_a_bundle_agrees_with_its_source(name: str, bundles: Bundles, pool: RuntimePool) -> None:
    report = compare_artefacts(fixture(name), [bundles(name)], runtimes=RUNTIMES, pool=pool)
    assert report.passed is True
    assert report.reference == "source/tensorflow"
    assert {(c.format, c.runtime) for c in report.comparisons} == {
        ("bytes", "tensorflow"),
        ("saved_model", "tensorflow"),
        ("tfjs", "tfjs-cpu"),
        ("onnx", "onnxruntime"),
    }


def test_last_weeks_bundle_against_todays(bundles: Bundles, tmp_path: Path, pool: RuntimePool) -> None:
    old, new = bundles("continuous"), tmp_path / "new"
    shutil.copytree(old, new)
    assert compare_artefacts(old, [new], runtimes=RUNTIMES, pool=pool).passed is True

    def moved(model: onnx.ModelProto) -> None:
        weight = next(t for t in model.graph.initializer if len(t.dims) == 2)
        values = numpy_helper.to_array(weight).copy()
        values[0, 0] += 0.1
        weight.CopyFrom(numpy_helper.from_array(values, weight.name))

    edited(new / "continuous.onnx", new / "continuous.onnx", moved)
    report = compare_artefacts(old, [new], runtimes=RUNTIMES, pool=pool)
    assert report.passed is False
    assert {(c.format, c.runtime) for c in report.failures} == {("onnx", "onnxruntime")}
    begins = report.failures[0].bisection
    assert begins is not None
    assert (begins.op, begins.index) == ("Const", (0, 0))
    assert begins.tensor in {t.name for t in onnx.load(new / "continuous.onnx").graph.initializer}


@pytest.mark.parametrize("kind", ["bytes", "onnx", "saved_model", "tfjs"])
def test_the_first_tensor_that_differs_is_named_in_every_format(
    kind: str, bundles: Bundles, tmp_path: Path, pool: RuntimePool
) -> None:
    """The candidate's kernel of the first layer is another one; its outputs alone would not say so."""
    source = tmp_path / "source.bytes"
    graph = schema.parse(schema.GraphDef, fixture("continuous").read_bytes(), "GraphDef")
    kernel = next(n for n in graph.node if n.op == "Const" and len(n.attr["value"].tensor.tensor_shape.dim) == 2)
    values = to_array(kernel.attr["value"].tensor).copy()
    values[1, 2] += 0.25
    kernel.attr["value"].tensor.CopyFrom(from_array(values))
    source.write_bytes(schema.serialise(graph))
    (result,) = export([source], ExportOptions(tmp_path / "out", verify="none"))
    reference = bundles("continuous")
    candidate = result.folder / WRITTEN[kind].main_of(result.policy.name)
    report = compare_artefacts(reference, [candidate], runtimes=RUNTIMES, pool=pool)
    assert report.passed is False
    for failure in report.failures:
        assert failure.bisection is not None, failure
        assert failure.bisection.tensor is not None, failure.bisection
        assert failure.bisection.op in ("Const", "MatMul", "BiasAdd"), failure.bisection


def test_candidates_of_one_format_are_told_apart(bundles: Bundles, tmp_path: Path, pool: RuntimePool) -> None:
    folder = bundles("discrete")
    other = shutil.copy(folder / "discrete.onnx", tmp_path / "theirs.onnx")
    report = compare_artefacts(
        fixture("discrete"), [folder / "discrete.onnx", Path(other)], runtimes="onnxruntime,tensorflow", pool=pool
    )
    assert report.passed is True
    assert {c.format for c in report.comparisons} == {
        "onnx discrete/discrete.onnx",
        f"onnx {tmp_path.name}/theirs.onnx",
    }


def test_labels_tell_candidates_apart_whatever_they_are_called(tmp_path: Path) -> None:
    found = [
        Artefact(tmp_path / "x", WRITTEN["onnx"], Ports(tmp_path / run / "out" / "policy.onnx", (), ()))
        for run in ("a", "b", "a")
    ]
    assert labels_of(found) == ["onnx a/out/policy.onnx", "onnx b/out/policy.onnx", "onnx a/out/policy.onnx (2)"]


def test_a_candidate_with_weights_beside_it_that_differs_is_a_failure_that_names_the_tensor(
    bundles: Bundles, tmp_path: Path, pool: RuntimePool
) -> None:
    """What is loaded, and bisected, is the vetted copy: it has its weights inside."""
    model = onnx.load(bundles("continuous") / "continuous.onnx")
    weights = max(model.graph.initializer, key=lambda t: len(t.raw_data))
    weights.raw_data = (numpy_helper.to_array(weights) * np.float32(1.5)).tobytes()
    onnx.save(model, tmp_path / "theirs.onnx", save_as_external_data=True, location="theirs.data", size_threshold=0)
    report = compare_artefacts(fixture("continuous"), [tmp_path / "theirs.onnx"], runtimes="onnxruntime", pool=pool)
    failure = next(c for c in report.comparisons if not c.passed)
    assert failure.bisection is not None


def test_the_names_of_the_source_are_known_too(bundles: Bundles, tmp_path: Path, pool: RuntimePool) -> None:
    """What tf2onnx makes of a graph has "node:0" for names."""

    def by_tensor(model: onnx.ModelProto) -> None:
        for value in [v.name for v in (*model.graph.input, *model.graph.output)]:
            renamed(model, value, f"{value}:0")

    file = edited(bundles("recurrent") / "recurrent.onnx", tmp_path / "theirs.onnx", by_tensor)
    assert compare_artefacts(fixture("recurrent"), [file], runtimes=RUNTIMES, pool=pool).passed is True


def test_what_was_made_for_a_bundle_is_not_asked_of_its_source(bundles: Bundles, pool: RuntimePool) -> None:
    report = compare_artefacts(bundles("recurrent"), [fixture("recurrent")], runtimes=RUNTIMES, pool=pool)
    assert report.passed is True
    assert any("never had it: deterministic_action" in note for note in report.notes)
    assert {c.output for c in report.comparisons} == {"action", "action_probs", "recurrent_out"}


def test_a_lost_name_of_ours_is_a_failure_that_says_what_to_map(
    bundles: Bundles, tmp_path: Path, pool: RuntimePool
) -> None:
    file = edited(
        bundles("discrete") / "discrete.onnx", tmp_path / "theirs.onnx", lambda m: renamed(m, "action", "Identity")
    )
    failure = only_failure(compare_artefacts(fixture("discrete"), [file], runtimes=RUNTIMES, pool=pool))
    assert (failure.output, failure.runtime) == ("action", "onnxruntime")
    assert "missing output 'action'" in failure.reason
    assert "--map action=Identity" in failure.reason


def of_another_maker(model: onnx.ModelProto) -> None:
    del model.metadata_props[:]


def test_an_output_of_another_name_is_found_by_its_role(bundles: Bundles, tmp_path: Path, pool: RuntimePool) -> None:
    def edit(model: onnx.ModelProto) -> None:
        of_another_maker(model)
        renamed(model, "action", "output")

    file = edited(bundles("continuous") / "continuous.onnx", tmp_path / "theirs.onnx", edit)
    for names in ({}, {"action": "output"}):
        report = compare_artefacts(fixture("continuous"), [file], names=names, runtimes=RUNTIMES, pool=pool)
        assert report.passed is True
        assert "action" in {c.output for c in report.comparisons}
        assert names or "onnx: action = output, by their roles" in report.notes


def test_a_web_model_without_its_signatures_names_is_run_by_its_roles(
    bundles: Bundles, tmp_path: Path, pool: RuntimePool
) -> None:
    folder = tmp_path / "tfjs"
    shutil.copytree(bundles("discrete") / "tfjs", folder)
    model = json.loads((folder / "model.json").read_text())
    signature = model["signature"]
    signature["outputs"] = {f"Identity_{i}": info for i, info in enumerate(signature["outputs"].values())}
    model.pop("userDefinedMetadata")
    (folder / "model.json").write_text(json.dumps(model))
    report = compare_artefacts(fixture("discrete"), [folder], runtimes=RUNTIMES, pool=pool)
    assert report.passed is True
    assert {(c.output, c.runtime) for c in report.comparisons} >= {
        ("action", "tfjs-cpu"),
        ("value_estimate", "tfjs-cpu"),
    }


def test_an_output_that_is_dropped_is_a_failure(bundles: Bundles, tmp_path: Path, pool: RuntimePool) -> None:
    def dropped(model: onnx.ModelProto) -> None:
        model.graph.output.remove(next(v for v in model.graph.output if v.name == "value_estimate"))

    file = edited(bundles("discrete") / "discrete.onnx", tmp_path / "theirs.onnx", dropped)
    failure = only_failure(compare_artefacts(fixture("discrete"), [file], runtimes=RUNTIMES, pool=pool))
    assert failure.output == "value_estimate"
    assert "missing output 'value_estimate'" in failure.reason


def test_an_op_that_the_runtime_does_not_know(bundles: Bundles, tmp_path: Path, pool: RuntimePool) -> None:
    """A converter that writes an op which ONNX has not, all the same."""

    def unknown(model: onnx.ModelProto) -> None:
        next(n for n in model.graph.node if n.op_type in ("MatMul", "Gemm")).op_type = "Betainc"

    file = edited(bundles("continuous") / "continuous.onnx", tmp_path / "theirs.onnx", unknown)
    failure = only_failure(compare_artefacts(fixture("continuous"), [file], runtimes=RUNTIMES, pool=pool))
    assert (failure.kind, failure.output) == ("failure", "*")
    assert "Betainc" in failure.reason


def endless(model: onnx.ModelProto) -> None:
    """Its action is added up in a loop that has no bound, and goes on as long as it is true that true is true."""
    body = helper.make_graph(
        [helper.make_node("Identity", ["again"], ["still"]), helper.make_node("Add", ["sum", "sum"], ["more"])],
        "body",
        [
            helper.make_tensor_value_info("turn", onnx.TensorProto.INT64, []),
            helper.make_tensor_value_info("again", onnx.TensorProto.BOOL, []),
            helper.make_tensor_value_info("sum", onnx.TensorProto.FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("still", onnx.TensorProto.BOOL, []),
            helper.make_tensor_value_info("more", onnx.TensorProto.FLOAT, None),
        ],
    )
    model.graph.initializer.append(numpy_helper.from_array(np.array(True), "true"))
    last = next(node for node in model.graph.node if "action" in node.output)
    last.output[list(last.output).index("action")] = "before"
    model.graph.node.append(helper.make_node("Loop", ["", "true", "before"], ["action"], body=body))


@pytest.mark.skipif(sys.platform != "linux", reason="no other system says how long a child has computed")
def test_a_candidate_that_loops_for_ever_is_stopped(
    bundles: Bundles, tmp_path: Path, pool: RuntimePool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("export_model.converters.files.children.time_limits.FIRST", 3.0)
    made = edited(bundles("continuous") / "continuous.onnx", tmp_path / "endless.onnx", endless)
    report = compare_artefacts(bundles("continuous"), [made], runtimes="onnxruntime", pool=pool)
    assert "did not come to an end" in only_failure(report).reason


def test_an_input_that_is_missing_is_a_failure(bundles: Bundles, tmp_path: Path, pool: RuntimePool) -> None:
    def masks_frozen(model: onnx.ModelProto) -> None:
        values = model.graph.input
        masks = next(v for v in values if v.name == "action_masks")
        width = masks.type.tensor_type.shape.dim[1].dim_value
        values.remove(masks)
        model.graph.initializer.append(numpy_helper.from_array(np.ones((1, width), np.float32), "action_masks"))

    file = edited(bundles("discrete") / "discrete.onnx", tmp_path / "theirs.onnx", masks_frozen)
    report = compare_artefacts(fixture("discrete"), [file], runtimes=RUNTIMES, pool=pool)
    assert report.passed is False
    reasons = {f.output: f.reason for f in report.failures}
    assert "missing input 'action_masks'" in reasons["action_masks"]


def test_a_batch_that_is_frozen_is_fed_in_its_size_and_another_width_is_a_failure(
    bundles: Bundles, tmp_path: Path, pool: RuntimePool
) -> None:
    def state(model: onnx.ModelProto) -> onnx.TensorShapeProto:
        return next(v for v in model.graph.input if v.name == "state").type.tensor_type.shape

    def frozen(model: onnx.ModelProto) -> None:
        of_another_maker(model)
        for value in model.graph.input:
            value.type.tensor_type.shape.dim[0].dim_value = 32

    def wide(model: onnx.ModelProto) -> None:
        state(model).dim[1].dim_value = 99

    source = bundles("continuous") / "continuous.onnx"
    file = edited(source, tmp_path / "theirs.onnx", frozen)
    report = compare_artefacts(fixture("continuous"), [file], runtimes=RUNTIMES, pool=pool)
    assert report.passed is True
    assert "onnx takes 32 rows at a time, and was compared so" in report.notes
    file = edited(source, tmp_path / "theirs.onnx", wide)
    report = compare_artefacts(fixture("continuous"), [file], runtimes=RUNTIMES, pool=pool)
    failure = next(f for f in report.failures if f.output == "state")
    assert "has the shape [?, 99], the reference's [?, 8]" in failure.reason


def test_classes_that_the_candidate_draws_itself_are_compared_by_numbers_and_distribution(
    bundles: Bundles, tmp_path: Path, pool: RuntimePool
) -> None:
    (kept,) = export([fixture("sampled")], ExportOptions(tmp_path, verify="none", name="kept"))
    report = compare_artefacts(fixture("sampled"), [kept.folder], runtimes=RUNTIMES, pool=pool)
    assert report.passed is True
    assert {c.kind for c in report.comparisons if c.output == "action"} == {"shape", "numbers", "draws"}


def drawing(spread: float | None) -> Callable[[onnx.ModelProto], None]:
    """An edit that takes the input ``epsilon`` away: drawn inside, ``spread`` times N(0, 1), or one value (None)."""

    def edit(model: onnx.ModelProto) -> None:
        graph = model.graph
        graph.input.remove(next(v for v in graph.input if v.name == "epsilon"))
        if spread is None:
            graph.initializer.append(numpy_helper.from_array(np.full((1, 2), 0.3, np.float32), "epsilon"))
            return
        for name, value in (("from", [0]), ("to", [1]), ("two", [2])):
            graph.initializer.append(numpy_helper.from_array(np.array(value, np.int64), name))
        graph.initializer.append(numpy_helper.from_array(np.array([spread], np.float32), "spread"))
        nodes = [
            helper.make_node("Shape", ["state"], ["of"]),
            helper.make_node("Slice", ["of", "from", "to"], ["rows"]),
            helper.make_node("Concat", ["rows", "two"], ["size"], axis=0),
            helper.make_node("ConstantOfShape", ["size"], ["zeros"]),
            helper.make_node("RandomNormalLike", ["zeros"], ["normal"]),
            helper.make_node("Mul", ["normal", "spread"], ["epsilon"]),
            *graph.node,
        ]
        del graph.node[:]
        graph.node.extend(nodes)

    return edit


@pytest.mark.parametrize(("spread", "right"), [(1.0, True), (1.5, False), (0.0, False), (np.nan, False), (None, False)])
def test_a_candidate_that_draws_its_own_noise_is_held_to_the_distribution(
    spread: float | None, right: bool, bundles: Bundles, tmp_path: Path, pool: RuntimePool
) -> None:
    file = edited(bundles("continuous") / "continuous.onnx", tmp_path / "theirs.onnx", drawing(spread))
    report = compare_artefacts(fixture("continuous"), [file], runtimes=RUNTIMES, pool=pool)
    assert report.passed is right, report.failures
    assert {f.output for f in report.failures} <= {"action", "action_probs"}
    assert right or "action" in {f.output for f in report.failures}


def test_bad_maps_are_refused(bundles: Bundles, pool: RuntimePool) -> None:
    file = bundles("discrete") / "discrete.onnx"
    with pytest.raises(UsageError, match="no input or output 'acton'") as caught:
        compare_artefacts(fixture("discrete"), [file], names={"acton": "action"}, runtimes=RUNTIMES, pool=pool)
    assert caught.value.fix == "did you mean action?"
    with pytest.raises(UsageError, match="no candidate has an input or output 'Identity'"):
        compare_artefacts(fixture("discrete"), [file], names={"action": "Identity"}, runtimes=RUNTIMES, pool=pool)


def test_a_reference_with_two_brains_needs_one_chosen(bundles: Bundles, pool: RuntimePool) -> None:
    with pytest.raises(UsageError, match="2 policies"):
        compare_artefacts(fixture("twobrains"), [bundles("discrete")], runtimes=RUNTIMES, pool=pool)


def test_where_nothing_ran_nothing_is_said_to_agree(bundles: Bundles, pool: RuntimePool) -> None:
    file = bundles("discrete") / "discrete.onnx"
    with pytest.raises(RuntimeUnavailableError, match="nothing was compared"):
        compare_artefacts(fixture("discrete"), [file], runtimes="numpy", pool=pool)


@pytest.mark.runtimes
def test_the_command_line_compares_and_reports(bundles: Bundles, tmp_path: Path) -> None:
    folder = bundles("discrete")
    lost = edited(folder / "discrete.onnx", tmp_path / "lost.onnx", lambda m: renamed(m, "action", "Identity"))
    command = ("compare", fixture("discrete"), lost, "--runtimes", "onnxruntime,tensorflow")
    ran = export_model(*command, "--junit", tmp_path / "j.xml", "--html", tmp_path / "p.html", "--markdown", "-")
    assert ran.status == 1
    assert "--map action=Identity" in ran.out
    assert "action" in (tmp_path / "p.html").read_text()
    read = ("--map", "action=Identity", "--input", "action_masks=masks", "--max-size", "1MB")
    right = export_model(*command, *read, "--json", "--html", tmp_path / "p.html")
    assert right.status == 0
    again = (tmp_path / "p.html").read_text().partition("To compare again")[2].partition("</code>")[0]
    assert all(f"{flag} {value}" in again for flag, value in zip(read[::2], read[1::2], strict=True))
    assert "--json" not in again
    (report,) = right.json["reports"]
    assert report["verdict"] == "passed"
    assert [c["kind"] for c in report["comparisons"] if c["output"] == "size"] == ["size"]
    is_refused(export_model(*command, "--map", "action"), "NAME=VALUE")


@pytest.mark.runtimes
def test_recorded_samples_are_run_and_held_against(bundles: Bundles, tmp_path: Path) -> None:
    folder = bundles("continuous")
    with np.load(fixture("continuous.npz")) as known:
        arrays = {k.rpartition("/")[2]: known[k] for k in known.files if k.startswith("b7/")}
    np.savez(tmp_path / "right.npz", **arrays)
    command = ("verify", folder, "--runtimes", "onnxruntime", "--json", "--golden")
    right = export_model(*command, tmp_path / "right.npz")
    assert right.status == 0
    comparisons = right.json["reports"][0]["comparisons"]
    assert {c["output"] for c in comparisons if c["format"] == "golden"} >= {"action", "value_estimate"}
    arrays["value_estimate"] = arrays["value_estimate"] + np.float32(0.01)
    np.savez(tmp_path / "wrong.npz", **arrays)
    wrong = export_model(*command, tmp_path / "wrong.npz")
    assert wrong.status == 1
    failed = [c for c in wrong.json["reports"][0]["comparisons"] if not c["passed"]]
    assert [(c["format"], c["output"], c["worst_input"]) for c in failed] == [
        ("golden", "value_estimate", "golden, rows 0-6")
    ]
    del arrays["epsilon"]
    np.savez(tmp_path / "partly.npz", state=arrays["state"], action=arrays["action"])
    partly = export_model(*command, tmp_path / "partly.npz")
    assert partly.status == 0, "an action that was drawn is not held against one without its noise"
