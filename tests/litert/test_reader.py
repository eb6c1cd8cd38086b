"""A .tflite as a source: ours gives the same bytes again, and others act as they do in LiteRT."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.formats.litert.importer.table import TABLE as OPERATORS
from export_model.converters.formats.litert.reader import read_litert
from export_model.converters.formats.litert.schema import BUILTINS
from export_model.converters.graph.ops.table import TABLE
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.errors import UnsupportedOpError
from fixtures import FIXTURES, path
from tests import known
from tests.commands import ROOT
from tests.conftest import Chosen
from tests.graph.harness import policy_of
from tests.graph.samples import SAMPLES
from tests.litert import make_models
from tests.litert.operators import IMAGE, X, answers, floats, ints, model_of
from tests.litert.sweep import round_trips, written

pytestmark = pytest.mark.xdist_group("litert-reader")


@pytest.mark.parametrize("name", FIXTURES)
def test_a_round_trip_gives_the_same_bytes(name: str, tmp_path: Path) -> None:
    for first, second in round_trips(path(name), tmp_path):
        assert first == second


@pytest.mark.corpus
@pytest.mark.slow
@pytest.mark.parametrize("source", known.params(known.sources()))
def test_every_policy_gives_the_same_bytes(source: Path, tmp_path: Path, is_new: Chosen) -> None:
    if not is_new("litert", known.policies_or_skip(source)):  # type: ignore[call-arg, arg-type]
        return
    for first, second in round_trips(source, tmp_path):
        assert first == second


def test_a_file_of_ours_is_what_its_contract_says(tmp_path: Path) -> None:
    (made,) = export([path("recurrent")], ExportOptions(tmp_path, ("litert",), verify="none"))
    (policy,) = read_source(made.folder / "recurrent.tflite").policies()
    wanted, found = made.policy.signature, policy.signature
    assert [(s.name, s.role, s.shape) for s in found.inputs] == [(s.name, s.role, s.shape) for s in wanted.inputs]
    assert [(s.name, s.role) for s in found.outputs] == [(s.name, s.role) for s in wanted.outputs]
    assert (found.family, found.algorithm, found.memory) == (wanted.family, wanted.algorithm, wanted.memory)


@pytest.mark.parametrize("storage", ["float16", "int8"])
def test_weights_in_fewer_bytes_are_widened(storage: Any, tmp_path: Path, processes: RuntimePool) -> None:
    """To what the file's own runtime makes of them; XNNPACK and the plain kernels widen alike."""
    options = ExportOptions(tmp_path, ("litert",), verify="none", weights=storage)
    (made,) = export([path("continuous")], options)
    check = ExportOptions(tmp_path / "again", ("onnx",), verify=("litert-plain", "onnxruntime"))
    (result,) = export([made.folder / "continuous.tflite"], check, pool=processes)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    assert result.report.original == "litert-plain"


# ------------------------------------------------------------------ files of TensorFlow's converter


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("tensorflow")
    folder = tmp_path_factory.mktemp("theirs")
    subprocess.run([sys.executable, "-m", "tests.litert.make_models", str(folder)], cwd=ROOT, check=True)
    return folder


READ = (
    *make_models.ACTIVATIONS,
    *("softmax", "image", "dilated", "cell", "gru", "attention", "conv1d", "conv1d-dilated", "halves"),
    *(f"saved-{name}" for name in make_models.SAVED),
    *(f"frozen-{name}" for name in make_models.FROZEN),
)


@pytest.mark.slow
@pytest.mark.parametrize("name", READ)
def test_files_of_tensorflow_s_converter_act_as_in_litert(
    name: str, theirs: Path, tmp_path: Path, processes: RuntimePool
) -> None:
    options = ExportOptions(tmp_path, ("onnx", "litert"), verify=("litert", "litert-plain", "onnxruntime"))
    (result,) = export([theirs / f"{name}.tflite"], options, pool=processes)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    assert result.report.original == "litert-plain"
    signature = result.policy.signature
    if name.startswith(("saved-", "frozen-")):  # names and roles as in the graph that it was converted from
        (wanted,) = (p.signature for p in read_source(path(name.partition("-")[2])).policies())
        assert {(s.name, s.role) for s in signature.inputs} == {(s.name, s.role) for s in wanted.inputs}
        assert signature.heads[0].spec.role == wanted.heads[0].spec.role
    assert (signature.memory is not None) is (name in ("cell", "saved-recurrent"))


@pytest.mark.slow
@pytest.mark.parametrize("name", make_models.REFUSED)
def test_quantised_and_stateful_models_are_refused_by_name(name: str, theirs: Path) -> None:
    with pytest.raises(UnsupportedOpError) as caught:
        read_source(theirs / f"{name}.tflite")
    assert make_models.REFUSED[name] in caught.value.what
    assert caught.value.why and caught.value.fix


# ------------------------------------------------------------------ operators

WINDOW = {"padding": 1, "stride_h": 1, "stride_w": 1}
IMAGE_OF_4 = floats(1, 6, 5, 4)
DILATED = {"dilation_h_factor": 1, "dilation_w_factor": 1}
#: What the writer makes none of: operators of other tools, options, forms of operands.
CASES: Mapping[str, tuple[Any, ...]] = {
    "BROADCAST_TO": ("BROADCAST_TO", [floats(1, 4), ints(3, 4)]),
    "CUMSUM": ("CUMSUM", [X, ints(1)], {"exclusive": True}),
    "CUMSUM, in reverse": ("CUMSUM", [X, ints(0)], {"reverse": True}),
    "GATHER_ND": ("GATHER_ND", [X, ints(2, 0, 1).reshape(3, 1)]),
    "GELU": ("GELU", [X]),
    "GELU by tanh": ("GELU", [X], {"approximate": True}),
    "HARD_SWISH": ("HARD_SWISH", [X * 3]),
    "L2_NORMALIZATION": ("L2_NORMALIZATION", [X]),
    "LEAKY_RELU": ("LEAKY_RELU", [X], {"alpha": 0.3}),
    "PRELU": ("PRELU", [X, floats(4)]),
    "CONV_2D in groups": ("CONV_2D", [IMAGE_OF_4, floats(6, 3, 3, 2), floats(6)], {**WINDOW, **DILATED, "stride_w": 2}),
    "CONV_2D, each channel": ("CONV_2D", [IMAGE_OF_4, floats(4, 3, 3, 1), floats(4)], {**WINDOW, **DILATED}),
    "REVERSE_V2": ("REVERSE_V2", [X, ints(1)]),
    "TRANSPOSE_CONV": (
        "TRANSPOSE_CONV",
        [ints(1, 14, 12, 3), floats(3, 4, 3, 4), IMAGE_OF_4],
        {"padding": 1, "stride_h": 2, "stride_w": 2},
    ),
    "SPACE_TO_BATCH_ND": ("SPACE_TO_BATCH_ND", [floats(2, 3, 6, 2), ints(2, 3), ints(1, 0, 2, 1).reshape(2, 2)]),
    "BATCH_TO_SPACE_ND": ("BATCH_TO_SPACE_ND", [floats(12, 2, 2, 3), ints(2, 3), ints(1, 0, 0, 2).reshape(2, 2)]),
    "RANK": ("RANK", [X], {}, ("int32",)),
    "RELU_0_TO_1": ("RELU_0_TO_1", [X]),
    "RELU_N1_TO_1": ("RELU_N1_TO_1", [X]),
    "TOPK_V2": ("TOPK_V2", [X, np.array(2, np.int32)], {}, ("float32", "int32")),
    "SOFTMAX, beta": ("SOFTMAX", [X], {"beta": 0.5}),
    "RESHAPE by its option": ("RESHAPE", [X], {"new_shape": [2, 6]}),
    "RESHAPE to a scalar": ("RESHAPE", [floats(1)], {"new_shape": [0]}),
    "ADD and RELU": ("ADD", [X, floats(4)], {"activation": 1}),
    "SUB and RELU_N1_TO_1": ("SUB", [X, floats(4)], {"activation": 2}),
    "MUL and RELU6": ("MUL", [X, floats(4)], {"activation": 3}),
    "FULLY_CONNECTED of three axes": ("FULLY_CONNECTED", [floats(2, 3, 4), floats(5, 4), floats(5)]),
    "FULLY_CONNECTED that keeps its axes": (
        "FULLY_CONNECTED",
        [floats(2, 3, 4), floats(5, 4), floats(5)],
        {"keep_num_dims": True, "activation": 1},
    ),
    "STRIDED_SLICE, ends by lengths": (
        "STRIDED_SLICE",
        [X, ints(1, 1), ints(2, 2), ints(1, 1)],
        {"offset": True},
    ),
    "STRIDED_SLICE, masks": (
        "STRIDED_SLICE",
        [X, ints(0, 1), ints(0, 2), ints(1, 1)],
        {"begin_mask": 1, "end_mask": 1, "shrink_axis_mask": 2},
    ),
    "CONV_2D, SAME, strides": (
        "CONV_2D",
        [IMAGE, floats(4, 3, 2, 3), floats(4)],
        {**DILATED, "padding": 0, "stride_h": 2, "stride_w": 1, "activation": 1},
    ),
    "CONV_2D, dilated": (
        "CONV_2D",
        [IMAGE, floats(4, 2, 2, 3), floats(4)],
        {**WINDOW, "dilation_h_factor": 2, "dilation_w_factor": 3},
    ),
    "DEPTHWISE_CONV_2D": (
        "DEPTHWISE_CONV_2D",
        [IMAGE, floats(1, 3, 3, 6), floats(6)],
        {**WINDOW, **DILATED, "depth_multiplier": 2},
    ),
    "AVERAGE_POOL_2D, SAME": (
        "AVERAGE_POOL_2D",
        [IMAGE],
        {"padding": 0, "stride_h": 2, "stride_w": 2, "filter_height": 3, "filter_width": 3},
    ),
    "BATCH_MATMUL, turned": ("BATCH_MATMUL", [floats(2, 4, 3), floats(2, 5, 4)], {"adj_x": True, "adj_y": True}),
}

#: Which operand is no constant, where it is not the first.
FED = {"TRANSPOSE_CONV": 2}


@pytest.mark.parametrize("title", CASES)
def test_operators_of_others_compute_what_litert_computes(title: str) -> None:
    kind, inputs, *rest = CASES[title]
    options = rest[0] if rest else {}
    results = rest[1] if len(rest) > 1 else ("float32",)
    first = FED.get(kind, 0)
    ours, theirs = answers(model_of(kind, inputs, results, first=first, **options), inputs[first : first + 1], first)
    for a, b in zip(ours, theirs, strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-6)


def test_every_operator_of_the_table_has_a_case_or_is_written() -> None:
    written_ones = {name for name, builtin in BUILTINS.items() if builtin.takes}
    cases = {case[0] for case in CASES.values()}
    assert OPERATORS.keys() | {"DEQUANTIZE"} == BUILTINS.keys()
    assert {name for name in OPERATORS if name not in written_ones} <= cases


SIZES = st.integers(1, 4)


@given(rows=SIZES, size=SIZES, results=SIZES, activation=st.integers(0, 3), biased=st.booleans())
def test_products_of_any_size(rows: int, size: int, results: int, activation: int, biased: bool) -> None:
    operands = [floats(rows, size), floats(results, size), *([floats(results)] if biased else [])]
    ours, theirs = answers(model_of("FULLY_CONNECTED", operands, activation=activation), operands[:1])
    np.testing.assert_allclose(ours[0], theirs[0], rtol=2e-5, atol=2e-6)


@given(
    size=st.integers(3, 7),
    kernel=st.tuples(st.integers(1, 3), st.integers(1, 3)),
    strides=st.tuples(st.integers(1, 3), st.integers(1, 3)),
    padding=st.integers(0, 1),
)
def test_convolutions_of_any_size(size: int, kernel: tuple[int, int], strides: tuple[int, int], padding: int) -> None:
    operands = [floats(1, size, size + 1, 2), floats(3, *kernel, 2), floats(3)]
    options = {**DILATED, "padding": padding, "stride_h": strides[0], "stride_w": strides[1]}
    ours, theirs = answers(model_of("CONV_2D", operands, **options), operands[:1])
    np.testing.assert_allclose(ours[0], theirs[0], rtol=2e-5, atol=1e-5)


@given(
    begin=st.tuples(st.integers(-5, 5), st.integers(-5, 5)),
    end=st.tuples(st.integers(-5, 5), st.integers(-5, 5)),
    steps=st.tuples(st.integers(1, 3), st.integers(-2, -1) | st.integers(1, 2)),
    masks=st.tuples(st.integers(0, 3), st.integers(0, 3)),
)
def test_slices_of_any_bounds(begin: Any, end: Any, steps: Any, masks: tuple[int, int]) -> None:
    operands = [X, ints(*begin), ints(*end), ints(*steps)]
    model = model_of("STRIDED_SLICE", operands, begin_mask=masks[0], end_mask=masks[1])
    ours, theirs = answers(model, operands[:1])
    assert ours[0].shape == theirs[0].shape
    np.testing.assert_array_equal(ours[0], theirs[0])


@pytest.mark.parametrize("op", [op for op in TABLE if TABLE[op].litert is not None and not TABLE[op].sampler])
def test_what_is_written_of_an_op_is_read_as_the_same(op: str) -> None:
    """By the numpy kernels: the graph that is read gives what the sample's own gives."""
    for sample in (s for s in SAMPLES if s.op == op):
        try:
            data = written(policy_of(sample.graph, sample.fetches), "")
        except UnsupportedOpError:
            continue  # a dtype that LiteRT lacks: tests/graph/test_ops.py
        found = read_litert(data)
        keys = [f"y{i}" for i in range(len(sample.fetches))]
        names = [found.signature.outputs[k].name for k in keys]
        ours = run_graph(found.graph, sample.feeds, names)
        wanted = run_graph(sample.graph, sample.feeds, sample.fetches)
        for name, fetch in zip(names, sample.fetches, strict=True):
            np.testing.assert_allclose(ours[name], wanted[fetch], rtol=2e-6, atol=2e-6, err_msg=sample.title)
