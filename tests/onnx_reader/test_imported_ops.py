"""Every ONNX op of the importer's table: imported and run by the numpy kernels, against onnxruntime."""

from __future__ import annotations

import numpy as np
import pytest

from export_model.converters.formats.onnx.importer.table import TABLE
from tests.onnx_reader.cases import arrays, choosing, elementwise, images, layers, linear
from tests.onnx_reader.models import Array, Bench, Case, imported, referenced

pytestmark = pytest.mark.xdist_group("onnx-ops")

CASES = [*elementwise.CASES, *linear.CASES, *arrays.CASES, *choosing.CASES, *images.CASES, *layers.CASES]
#: Samplers have tests of their own; a loop is refused; these came with opsets that onnxruntime has not all of.
ELSEWHERE = {"RandomNormal", "RandomNormalLike", "RandomUniform", "RandomUniformLike", "Multinomial", "Loop"}
NEWER = {"RMSNormalization", "Swish", "CumProd"}


def test_every_op_has_cases() -> None:
    assert {kind for _, kind in TABLE} - ELSEWHERE - NEWER - {c.op for c in CASES} == set()
    titles = [(c.op, c.title) for c in CASES]
    assert len(titles) == len(set(titles))


each_case = pytest.mark.parametrize("case", [pytest.param(c, id=f"{c.op}: {c.title}") for c in CASES])


@each_case
def test_agrees_with_onnxruntime(case: Case, bench: Bench) -> None:
    for opset in case.opsets:
        path = bench.place(case.model(opset))
        run = bench.onnxruntime if case.oracle == "onnxruntime" else referenced
        expected = run(path, case.feeds, case.outputs)
        got = imported(path, case.feeds, case.outputs)
        compare(case, expected, got, f"opset {opset}")


@each_case
def test_tensorflow_runs_what_was_imported(case: Case, bench: Bench) -> None:
    bench.need("tensorflow")
    path = bench.place(case.model(case.opsets[-1]))
    expected = imported(path, case.feeds, case.outputs)
    compare(case, expected, bench.tensorflow(path, case.feeds, case.outputs), "TensorFlow")


def compare(case: Case, expected: list[Array], got: list[Array], where: str) -> None:
    for name, wanted, value in zip(case.outputs, expected, got, strict=True):
        assert (value.dtype, value.shape) == (wanted.dtype, wanted.shape), f"{where}, {name}"
        np.testing.assert_allclose(value, wanted, atol=case.atol, rtol=case.rtol, err_msg=f"{where}, {name}")
