"""Every fixture's TensorFlow.js and ONNX artefacts in Chromium, against TensorFlow running the original."""

from __future__ import annotations

import contextlib
import json
import math
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes
from export_model.exporter.export.again import verify_folder
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify.options import VerifyOptions
from fixtures import FIXTURES
from fixtures import path as fixture
from tests.browser.conftest import BROWSERS, ONNX, TFJS

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.xdist_group("browser")]

PAIRS = {*(("tfjs", r) for r in TFJS), *(("onnx", r) for r in ONNX)}
#: The kernels of two are those of Node: they run an image here, WebGL and ONNX Runtime all of it.
IN_NODE_TOO, THEIRS = ("tfjs-cpu@chromium", "tfjs-wasm@chromium"), ("visual",)
#: One number of samples: new shapes cost, new numbers do not.
PARITY = VerifyOptions(samples=1)


@pytest.fixture
def reference() -> str:
    info = next(i for i in available_runtimes() if i.name == "tensorflow")
    if not info.installed:
        pytest.skip(f"tensorflow is not installed: {info.how}")
    return info.name


@pytest.mark.parametrize("name", FIXTURES)
def test_a_fixture_agrees_in_every_browser_runtime(
    name: str, tmp_path: Path, browsers: RuntimePool, reference: str
) -> None:
    asked = [b for b in BROWSERS if name in THEIRS or b not in IN_NODE_TOO]
    options = ExportOptions(tmp_path, ("bytes", "tfjs", "onnx"), verify=[reference, *asked], parity=PARITY)
    results = list(export([fixture(name)], options, pool=browsers))
    assert results
    for result in results:
        report = result.report
        assert report is not None
        assert report.passed is True, "\n".join(failure_lines(report))
        assert report.reference == "source/tensorflow"
        outputs = {s.name for s in result.policy.signature.outputs}
        for pair in (p for p in PAIRS if p[1] in asked):
            own = [c for c in report.comparisons if (c.format, c.runtime) == pair]
            assert {c.output for c in own} == outputs
            # WebGL too holds what Node's runtimes hold: it has no tolerance of its own
            assert {(c.tolerance.atol, c.tolerance.rtol) for c in own} == {(1e-5, 1e-5)}
        versions = {n: r["version"] for n, r in report.runtimes.items() if n in asked}
        assert all(" in Chromium " in (v or "") for v in versions.values()), versions


def spoil(folder: Path) -> None:
    """Makes the matrices of a TensorFlow.js model, which come as float32 in one shard, a hundredth larger."""
    (group,) = json.loads((folder / "model.json").read_text())["weightsManifest"]
    shard = folder / group["paths"][0]
    data, offset = bytearray(shard.read_bytes()), 0
    for weight in group["weights"]:
        end = offset + 4 * math.prod(weight["shape"])
        if len(weight["shape"]) == 2:
            data[offset:end] = (np.frombuffer(data[offset:end], np.float32) * np.float32(1.01)).tobytes()
        offset = end
    assert offset == len(data)
    shard.write_bytes(data)


def test_a_bundle_is_verified_again_in_a_browser_and_a_wrong_weight_is_found(
    tmp_path: Path, browsers: RuntimePool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("export_model.exporter.export.again.RuntimePool", lambda: contextlib.nullcontext(browsers))
    options = ExportOptions(tmp_path, ("bytes", "tfjs"), verify="none")
    (result,) = export([fixture("recurrent")], options)
    wanted = ["tfjs-wasm@chromium"]
    report = verify_folder(result.folder, runtimes=wanted, options=PARITY)
    assert report.passed is True, "\n".join(failure_lines(report))
    assert {c.runtime for c in report.comparisons} == set(wanted)
    assert any(len(c.drift) == PARITY.steps for c in report.comparisons if c.runtime in wanted)

    spoil(result.folder / "tfjs")
    monkeypatch.setattr(
        "export_model.converters.formats.bundle.bundle.Bundle.verify_hashes", lambda bundle, wanted=None: None
    )
    report = verify_folder(result.folder, runtimes=wanted, options=PARITY)
    assert report.passed is False
    assert {c.runtime for c in report.comparisons if not c.passed} == set(wanted)
