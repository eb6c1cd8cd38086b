"""Policies as .tflite files in LiteRT, with XNNPACK and without: they act as their sources do."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.compiler.passes.weights import Storage
from export_model.converters.files.children.process import RunFailedError
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.litert.artifact import vetted
from export_model.converters.formats.litert.flatbuffer import decode, encode
from export_model.converters.formats.litert.schema import BUILTINS
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.table import TABLE
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes
from export_model.exporter.export.pipeline import ExportOptions, ExportResult, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify.options import VerifyOptions
from export_model.signatures.contract import parse
from export_model.signatures.errors import UnsupportedOpError
from fixtures import FIXTURES, FOLDER, path
from tests import known
from tests.comparing import compare_artefacts
from tests.conftest import Chosen
from tests.exporting import verify_bundle
from tests.graph.harness import policy_of
from tests.graph.making import const, graph, node, placeholder

LITERT = ("litert", "litert-plain")
pytestmark = pytest.mark.xdist_group("litert")

#: What TensorFlow 2.21's converter makes of our SavedModels with both signatures, in bytes (measured 2026-11-23).
THEIR_SIZES = {"continuous": 51_344, "discrete": 39_772, "recurrent": 36_824, "visual": 86_696}


@pytest.fixture(scope="module")
def here(processes: RuntimePool) -> RuntimePool:
    missing = [i for i in available_runtimes() if i.name in LITERT and not i.installed]
    if missing:
        pytest.skip(f"{missing[0].name} is not installed: {missing[0].how}")
    return processes


def exported(source: Path, folder: Path, pool: RuntimePool, *targets: str) -> list[ExportResult]:
    options = ExportOptions(folder, targets=("litert", *targets), verify=(*LITERT, "onnxruntime"))
    return list(export([source], options, pool=pool))


@pytest.mark.parametrize("name", FIXTURES)
def test_fixtures_agree_under_both_signatures(name: str, tmp_path: Path, here: RuntimePool) -> None:
    for result in exported(path(name), tmp_path, here, "onnx"):
        report = result.report
        assert report is not None
        assert report.passed is True, "\n".join(failure_lines(report))
        ran = {(c.format, c.runtime) for c in report.comparisons}
        assert ran >= {("litert", runtime) for runtime in LITERT}
        assert ran >= {("litert:deterministic", runtime) for runtime in LITERT}
        assert {p.name for p in result.folder.iterdir()} >= {f"{result.policy.name}.tflite", "policy.json"}


def test_what_litert_computes_otherwise_at_the_ends_of_float32_is_named(tmp_path: Path, here: RuntimePool) -> None:
    """An exponential of observations of 1e4: what a user sees is which tensor, where and what LiteRT made of it."""
    source = FOLDER / "torchscript" / "shrunk_trace.pt"
    options = ExportOptions(tmp_path, ("litert",), verify="litert,litert-plain")
    (result,) = export([source], options, pool=here)
    assert result.report is not None and result.report.passed is False
    found = {f.runtime: f.bisection for f in result.report.failures if f.format == "litert" and f.bisection is not None}
    assert [(r, b.op, str(b.expected), str(b.got)) for r, b in sorted(found.items())] == [
        ("litert", "Sigmoid", "1.0", "nan"),  # expected 1: no rounding, no fault of the file
        ("litert-plain", "Sub", "inf", "3.4028234663852886e+38"),
    ]


@pytest.mark.parametrize("name", THEIR_SIZES)
def test_files_are_no_larger_than_those_of_tensorflow_s_converter(name: str) -> None:
    (policy,) = read_source(path(name)).policies()
    artefact = WRITTEN["litert"].artifact(policy, WriteOptions(json.dumps(policy.signature.to_dict())))
    assert artefact.size <= THEIR_SIZES[name]


@pytest.mark.parametrize("storage", ["float16", "int8"])
@pytest.mark.parametrize("name", ["continuous", "discrete", "recurrent", "visual"])
def test_weights_in_fewer_bytes_compute_what_the_rounded_policy_does(
    name: str, storage: Storage, tmp_path: Path, here: RuntimePool
) -> None:
    """To the usual tolerance, and every weight to the last bit; XNNPACK widens them when it loads the file."""
    whole = WRITTEN["litert"].artifact(read_source(path(name)).policies()[0], WriteOptions("{}")).size
    options = ExportOptions(tmp_path, ("litert",), verify=LITERT, weights=storage)
    (result,) = export([path(name)], options, pool=here)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    assert (result.folder / f"{name}.tflite").stat().st_size < 0.8 * whole


@pytest.mark.corpus
@pytest.mark.slow
@pytest.mark.parametrize("source", known.params(known.sources()))
def test_every_policy_that_is_written_as_onnx_acts_alike(
    source: Path, tmp_path: Path, here: RuntimePool, is_new: Chosen
) -> None:
    """All 449 were written and agreed on 23 November 2026; here those run that have something that none before had."""
    policies = known.policies_or_skip(source)
    for policy in policies:
        WRITTEN["litert"].artifact(policy, WriteOptions("{}"))
    if not is_new("litert", policies):  # type: ignore[call-arg, arg-type]
        return
    parity = VerifyOptions(seed=3)
    for result in export([source], ExportOptions(tmp_path, ("litert",), verify=LITERT, parity=parity), pool=here):
        assert result.report is not None
        assert result.report.passed is True, "\n".join(failure_lines(result.report))


# ------------------------------------------------------------------ what stands in a file


def test_a_file_tells_its_contract_and_both_signatures(tmp_path: Path) -> None:
    (result,) = export([path("continuous")], ExportOptions(tmp_path, ("litert",), verify="none"))
    file = result.folder / "continuous.tflite"
    held = WRITTEN["litert"].held
    assert held is not None
    assert parse(json.loads(held(file) or "")).signature == result.policy.signature
    model = decode(file.read_bytes())
    names = {s["signature_key"]: [e["name"] for e in s["inputs"]] for s in model["signature_defs"]}
    assert names == {"serving_default": ["state", "epsilon"], "deterministic": ["state"]}
    ports = WRITTEN["litert"].ports
    assert ports is not None
    found = ports(file)
    assert [(p.name, p.dtype, p.shape) for p in found.inputs] == [
        ("state", "float32", (None, 8)),
        ("epsilon", "float32", (None, 2)),
    ]
    assert "action" in [p.name for p in found.outputs]


def test_there_is_one_buffer_for_a_constant_and_no_operator_that_a_fused_one_does() -> None:
    weights, bias = np.ones((8, 8), np.float32), np.ones(8, np.float32)
    layers = [placeholder("x", (None, 8)), const("w", weights), const("b", bias)]
    last = "x"
    for i in range(3):
        layers += [node(f"m{i}", "MatMul", last, "w"), node(f"a{i}", "BiasAdd", f"m{i}", "b")]
        layers.append(node(f"r{i}", "Relu", f"a{i}"))
        last = f"r{i}"
    (data,) = WRITTEN["litert"].artifact(policy_of(graph(*layers), [last]), WriteOptions("{}")).files.values()
    model = decode(data.to_bytes())
    (subgraph,) = model["subgraphs"]
    # the last is the copy that gives the output its name
    names = [model["operator_codes"][o.get("opcode_index", 0)]["builtin_code"] for o in subgraph["operators"]]
    assert names[:3] == [BUILTINS["FULLY_CONNECTED"].code] * 3
    assert [o["builtin_options"]["activation"] for o in subgraph["operators"][:3]] == [1, 1, 1]
    assert sorted(len(b["data"]) for b in model["buffers"][1:])[-2:] == [32, 256]


def test_no_shape_of_a_shape_is_left_and_no_bias_of_zeros(here: RuntimePool, tmp_path: Path) -> None:
    """A MatMul of rank 3 is one of rank 2 between two shapes; the graph's own shape follows on them."""
    random = np.random.default_rng(3)
    made = graph(
        placeholder("x", (None, 5, 4)),
        const("w", random.normal(size=(4, 6)).astype(np.float32)),
        const("zeros", np.zeros(6, np.float32)),
        const("heads", np.array([-1, 5, 2, 3], np.int32)),
        const("rows", np.array([-1, 6], np.int32)),
        node("product", "BatchMatMul", "x", "w", adj_x=False, adj_y=False),
        node("biased", "BiasAdd", "product", "zeros"),
        node("split", "Reshape", "biased", "heads"),
        node("again", "Reshape", "split", "rows"),
        node("activated", "Relu", "again"),
        node("turned", "Neg", "split"),
    )
    artefact = WRITTEN["litert"].artifact(policy_of(made, ["activated", "turned", "product"]), WriteOptions("{}"))
    artefact.write(tmp_path)
    model = decode((tmp_path / artefact.main).read_bytes())
    (subgraph,) = model["subgraphs"]
    codes = [model["operator_codes"][o.get("opcode_index", 0)]["builtin_code"] for o in subgraph["operators"]]
    made_by = {o["outputs"][0]: c for o, c in zip(subgraph["operators"], codes, strict=True)}
    shapes = [o for o, c in zip(subgraph["operators"], codes, strict=True) if c == BUILTINS["RESHAPE"].code]
    assert shapes and not any(made_by.get(o["inputs"][0]) == BUILTINS["RESHAPE"].code for o in shapes)
    assert BUILTINS["ADD"].code not in codes
    read = {v for o in subgraph["operators"] for v in o["inputs"]} | set(subgraph["outputs"])
    assert set(range(len(subgraph["tensors"]))) == read | set(subgraph["inputs"])
    used = {entry.get("buffer", 0) for entry in (*subgraph["tensors"], *model.get("metadata", ()))}
    assert used == set(range(len(model["buffers"])))
    x = random.normal(size=(2, 5, 4)).astype(np.float32)
    product = x @ next(n.value for n in made.nodes if n.name == "w")
    for runtime in LITERT:
        with here.process(runtime).load(str(tmp_path / artefact.main), kind="litert") as loaded:
            found = loaded.run({"x": x}, ["y0", "y1", "y2"])
        np.testing.assert_allclose(found["y0"], np.maximum(product.reshape(-1, 6), 0), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(found["y1"], -product.reshape(-1, 5, 2, 3), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(found["y2"], product, rtol=1e-5, atol=1e-6)


def test_signatures_of_the_same_tensors_share_a_function() -> None:
    (policy,) = read_source(path("recurrent")).policies()
    (data,) = WRITTEN["litert"].artifact(policy, WriteOptions("{}")).files.values()
    model = decode(data.to_bytes())
    assert len(model["signature_defs"]) == 2
    assert len(model["subgraphs"]) == 1


def test_outputs_that_are_inputs_constants_or_one_another_are_copies(here: RuntimePool, tmp_path: Path) -> None:
    made = graph(placeholder("x", (None, 3)), const("c", np.ones((1, 3), np.float32)), node("y", "Tanh", "x"))
    artefact = WRITTEN["litert"].artifact(policy_of(made, ["x", "c", "y", "y"]), WriteOptions("{}"))
    artefact.write(tmp_path)
    x = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
    for runtime in LITERT:
        with here.process(runtime).load(str(tmp_path / artefact.main), kind="litert") as model:
            got = model.run({"x": x}, ["y0", "y1", "y2", "y3"])
        assert np.array_equal(got["y0"], x)
        assert np.array_equal(got["y1"], [[1, 1, 1]])
        np.testing.assert_allclose(got["y2"], np.tanh(x), rtol=1e-5)
        assert np.array_equal(got["y2"], got["y3"])


# ------------------------------------------------------------------ refused by name


def test_what_litert_has_no_operator_for_is_refused_by_its_name() -> None:
    lacking = sorted(op.name for op in TABLE.values() if op.kernel is not None and op.litert is None and not op.older)
    assert lacking == ["Const", "Rank", "TruncatedNormal"]
    drawn = Node("draw", "TruncatedNormal", ("size",), {"dtype": np.dtype(np.float32), "seed": 0, "seed2": 0})
    made = graph(placeholder("x", (None, 3)), node("size", "Shape", "x", out_type=np.dtype(np.int32)), drawn)
    with pytest.raises(UnsupportedOpError, match=r"node 'draw' \(TruncatedNormal\) is not written to \.tflite"):
        WRITTEN["litert"].artifact(policy_of(made, ["draw"]), WriteOptions("{}"))


def test_a_dtype_that_an_operator_lacks_is_refused_with_its_name() -> None:
    kind = np.dtype(np.int64)
    made = graph(placeholder("x", (None, 3), kind), const("c", np.ones(3, np.int64)), node("y", "RealDiv", "x", "c"))
    with pytest.raises(UnsupportedOpError) as caught:
        WRITTEN["litert"].artifact(policy_of(made, ["y"]), WriteOptions("{}"))
    assert "its DIV does not take int64" in str(caught.value)


# ------------------------------------------------------------------ bundles, files of others


def test_a_bundle_is_verified_again_and_a_changed_weight_is_found(here: RuntimePool, tmp_path: Path) -> None:
    (result,) = exported(path("continuous"), tmp_path, here, "bytes")
    assert verify_bundle(result.folder, runtimes=list(LITERT)).passed
    file = result.folder / "continuous.tflite"
    model = decode(file.read_bytes())
    weights = max(model["buffers"], key=lambda b: len(b.get("data", b"")))
    array = np.frombuffer(bytes(weights["data"]), np.float32).copy()
    array[7] += 0.5
    weights["data"] = array
    data = encode(model).to_bytes()
    report = compare_artefacts(path("continuous"), _file(tmp_path / "theirs.tflite", data), runtimes=list(LITERT))
    assert not report.passed
    assert any("kernel" in str(f.bisection) for f in report.failures if f.bisection is not None)


def _file(place: Path, data: bytes) -> Path:
    place.write_bytes(data)
    return place


def test_a_stranger_s_operator_is_not_handed_to_the_runtime(tmp_path: Path) -> None:
    (policy,) = read_source(path("continuous")).policies()
    (data,) = WRITTEN["litert"].artifact(policy, WriteOptions("{}")).files.values()
    model = decode(data.to_bytes())
    custom = {"builtin_code": 32, "deprecated_builtin_code": 32, "custom_code": "FlexReadFile"}
    for code, name in ((custom, "FlexReadFile"), ({"builtin_code": 999}, "operator 999")):
        changed = {**model, "operator_codes": [*model["operator_codes"], code]}
        file = _file(tmp_path / "theirs.tflite", encode(changed).to_bytes())
        with pytest.raises(UnsupportedOpError, match=name):
            vetted(file, [], tmp_path)


def test_a_file_without_signatures_is_called_by_its_tensors(here: RuntimePool, tmp_path: Path) -> None:
    """As ``tf.lite`` of 2019 wrote them."""
    made = graph(placeholder("x", (None, 3)), node("y", "Tanh", "x"))
    (data,) = WRITTEN["litert"].artifact(policy_of(made, ["y"]), WriteOptions("{}")).files.values()
    model = decode(data.to_bytes())
    del model["signature_defs"]
    file = _file(tmp_path / "old.tflite", encode(model).to_bytes())
    ports = WRITTEN["litert"].ports
    assert ports is not None
    found = ports(file)
    x = np.ones((2, 3), np.float32)
    with here.process("litert").load(str(file), **found.options) as loaded:
        (name,) = [p.name for p in found.outputs]
        np.testing.assert_allclose(loaded.run({"x": x}, [name])[name], np.tanh(x), rtol=1e-6)
        with pytest.raises(RunFailedError, match="nothing"):
            loaded.run({"x": x}, ["nothing"])
