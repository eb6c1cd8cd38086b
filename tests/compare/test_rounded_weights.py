"""Bundles with rounded weights, judged alike by export, verify and compare."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from export_model.converters.compiler.passes.weights import Storage
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.compare.weights import rounded_to
from export_model.exporter.export.again import verify_folder
from export_model.exporter.export.pipeline import ExportOptions, export
from fixtures import path as fixture
from tests.comparing import compare_artefacts
from tests.faults.artefacts import opened

RUNTIMES = "onnxruntime,tensorflow"


def exported(name: str, storage: Storage, tmp_path: Path) -> Path:
    options = ExportOptions(tmp_path / storage, weights=storage, verify="none")
    (result,) = export([fixture(name)], options)
    return result.folder


@pytest.mark.parametrize("storage", ["int8", "float16"])
@pytest.mark.parametrize("name", ["continuous", "discrete"])
def test_a_bundle_is_judged_by_its_decisions(name: str, storage: Storage, tmp_path: Path, pool: RuntimePool) -> None:
    folder = exported(name, storage, tmp_path)
    compared = compare_artefacts(fixture(name), [folder], runtimes=RUNTIMES, pool=pool)
    again = verify_folder(folder, source=fixture(name), runtimes=RUNTIMES)
    judged = [
        {(c.output, round(c.max_abs_diff, 6)) for c in r.comparisons if c.kind == "decisions"}
        for r in (compared, again)
    ]
    assert judged[0] == judged[1]
    assert judged[0]
    assert compared.passed is again.passed is True
    for part in ("onnx/policy.onnx", "tfjs/model.json", "policy.onnx", "saved_model"):
        if (folder / part).exists():
            assert rounded_to(folder / part) == storage
    whole, *_ = export([fixture(name)], ExportOptions(tmp_path / "whole", verify="none"))
    both = compare_artefacts(fixture(name), [folder, whole.folder], runtimes="onnxruntime", pool=pool)
    assert both.passed is True
    assert len({c.format for c in both.comparisons if c.format.startswith("onnx")}) == 2


def test_a_weight_that_is_wrong_beside_its_rounding_is_found(tmp_path: Path, pool: RuntimePool) -> None:
    folder = exported("continuous", "int8", tmp_path)
    artefact = opened("onnx", folder)
    model: onnx.ModelProto = artefact.model  # type: ignore[attr-defined]
    narrow = next(t for t in model.graph.initializer if t.data_type == onnx.TensorProto.INT8)
    value = np.array(numpy_helper.to_array(narrow))
    value.flat[0] = value.flat[0] // 2 + 40
    narrow.CopyFrom(numpy_helper.from_array(value, narrow.name))
    artefact.save()
    compared = compare_artefacts(fixture("continuous"), [folder], runtimes="onnxruntime", pool=pool)
    again = verify_folder(folder, source=fixture("continuous"), runtimes="onnxruntime")
    for report in (compared, again):
        assert report.passed is False
        assert {f.format for f in report.failures} == {"onnx"}
