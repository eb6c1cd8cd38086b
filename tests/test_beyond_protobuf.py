"""Policies that one protobuf message cannot hold: weights beside the model. The limit is lowered for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.formats.registry import WRITTEN
from export_model.converters.formats.saved_model.writer import DETERMINISTIC, SERVING
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import TooLargeError
from export_model.signatures.sampling import draw_cases
from fixtures import path as fixture


@pytest.fixture(autouse=True)
def _low_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("export_model.converters.files.external_data.MAX_MESSAGE", 10_000)
    monkeypatch.setattr("export_model.converters.files.external_data.LARGE_FILE", 10_000)


def test_weights_lie_beside_the_model_and_the_runtimes_find_them(tmp_path: Path, pool: RuntimePool) -> None:
    options = ExportOptions(tmp_path / "out", verify=("onnxruntime", "tensorflow"))
    (result,) = export([fixture("continuous.bytes")], options, pool=pool)
    files = {str(p.relative_to(result.folder)) for p in result.folder.rglob("*") if p.is_file()}
    variables = {f"saved_model/variables/variables.{end}" for end in ("index", "data-00000-of-00001")}
    assert files >= {"continuous.onnx.data", *variables}
    assert "continuous.bytes" not in files
    assert any("bytes was left out" in note for note in result.notes)
    assert result.report is not None
    assert result.report.passed
    names = [s.name for s in result.policy.signature.outputs]
    (case,) = draw_cases(result.policy.signature, seed=1, samples=1)[:1]
    expected = run_graph(result.policy.graph, case.feeds, names)
    for kind, runtime in (("saved_model", "tensorflow"), ("onnx", "onnxruntime")):
        form = WRITTEN[kind]
        place = result.folder / form.main_of("continuous")
        (read,) = read_source(place).policies()
        assert [s.name for s in read.signature.outputs] == names
        assert form.vetted is not None
        (tmp_path / kind).mkdir()
        copy = form.vetted(place, [SERVING, DETERMINISTIC] if form.signatures else names, tmp_path / kind)
        assert any(p.stat().st_size >= 32768 for p in copy.parent.rglob("*.data*"))  # the weights, once
        model = pool.process(runtime).load(str(copy), **form.loader(SERVING))
        for name, value in model.run(case.feeds, names).items():
            np.testing.assert_allclose(value, expected[name], rtol=1e-5, atol=1e-5, err_msg=f"{kind} {name}")
        model.unload()


def test_a_bytes_that_nothing_could_read_is_refused_where_it_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(TooLargeError, match="cannot be read"):
        list(export([fixture("continuous.bytes")], ExportOptions(tmp_path, targets=["bytes"], verify="none")))
    assert not list(tmp_path.iterdir())
