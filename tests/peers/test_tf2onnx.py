"""``python -m tf2onnx.convert`` takes our ``.bytes``, and what it makes agrees with our own ONNX model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from export_model.converters.files.children.process import LoadedModel, RuntimeProcess
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes
from export_model.exporter.export.pipeline import ExportResult
from tests.peers.agreement import POLICIES, Run, disagreements
from tests.peers.conftest import Theirs

pytestmark = [pytest.mark.slow, pytest.mark.peers, pytest.mark.xdist_group("peers")]


@pytest.fixture(scope="module")
def onnxruntime(processes: RuntimePool) -> RuntimeProcess:
    info = next(i for i in available_runtimes() if i.name == "onnxruntime")
    if not info.installed:
        pytest.skip(f"onnxruntime is not installed: {info.how}")
    return processes.process("onnxruntime")


def by_tensor(model: LoadedModel) -> Run:
    """Run a model whose inputs and outputs are called "node:0", as tf2onnx leaves them."""

    def run(feeds: Mapping[str, np.ndarray], fetch: Sequence[str]) -> dict[str, np.ndarray]:
        results = model.run({f"{n}:0": a for n, a in feeds.items()}, [f"{n}:0" for n in fetch])
        return {n: results[f"{n}:0"] for n in fetch}

    return run


@pytest.mark.parametrize("name", POLICIES)
def test_its_model_agrees_with_ours(
    name: str, by_tf2onnx: Theirs, bundles: dict[str, ExportResult], onnxruntime: RuntimeProcess
) -> None:
    bundle = bundles[name]
    ours, theirs = onnxruntime.load(str(bundle.folder / f"{name}.onnx")), onnxruntime.load(str(by_tf2onnx(name)))
    assert not disagreements(bundle.policy, ours.run, by_tensor(theirs))
    ours.unload()
    theirs.unload()
