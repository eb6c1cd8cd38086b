"""Our SavedModel goes through the real ``tensorflowjs_converter``, and what comes out agrees with our own TFJS model.

The converter renames: where two outputs have the same dtype and shape, their keys become "action:0" and
"action_probs:0" in place of "action" and "action_probs". The nodes keep their names, so results are fetched by node.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.files.children.process import RuntimeProcess
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes
from export_model.exporter.export.pipeline import ExportResult
from tests.peers.agreement import POLICIES, disagreements
from tests.peers.conftest import Theirs
from tests.peers.environment import Peers

pytestmark = [pytest.mark.slow, pytest.mark.peers, pytest.mark.xdist_group("peers")]


@pytest.fixture(scope="module")
def tfjs(processes: RuntimePool) -> RuntimeProcess:
    info = next(i for i in available_runtimes() if i.name == "tfjs-cpu")
    if not info.installed:
        pytest.skip(f"TensorFlow.js is not installed: {info.how}")
    return processes.process("tfjs-cpu")


def model_of(folder: Path) -> dict[str, Any]:
    model: dict[str, Any] = json.loads((folder / "model.json").read_text(encoding="utf-8"))
    return model


def nodes(entries: dict[str, dict[str, str]]) -> set[str]:
    """The nodes that a signature's entries stand for."""
    return {entry["name"].removesuffix(":0") for entry in entries.values()}


@pytest.mark.parametrize("name", POLICIES)
def test_its_model_agrees_with_ours(
    name: str, official: Theirs, bundles: dict[str, ExportResult], tfjs: RuntimeProcess
) -> None:
    bundle = bundles[name]
    model = model_of(official(name))
    signature = bundle.policy.signature
    assert nodes(model["signature"]["inputs"]) == {s.name for s in signature.inputs}
    assert nodes(model["signature"]["outputs"]) == {s.name for s in signature.outputs}
    ours, theirs = tfjs.load(str(bundle.folder / "tfjs")), tfjs.load(str(official(name)))
    assert not disagreements(bundle.policy, ours.run, theirs.run)
    ours.unload()
    theirs.unload()


def test_the_signature_without_noise_goes_through_too(
    tmp_path: Path, peers: Peers, bundles: dict[str, ExportResult], tfjs: RuntimeProcess
) -> None:
    """By the package's own console script."""
    source, out = str(bundles["continuous"].folder / "saved_model"), str(tmp_path / "theirs")
    options = ["--input_format=tf_saved_model", "--signature_name=deterministic"]
    peers.run([*peers.tensorflowjs_converter(), *options, source, out])
    model = model_of(tmp_path / "theirs")
    assert nodes(model["signature"]["inputs"]) == {"state"}
    assert "deterministic_action" in nodes(model["signature"]["outputs"])
    tfjs.load(str(tmp_path / "theirs")).unload()


def test_a_difference_would_be_seen(bundles: dict[str, ExportResult], tfjs: RuntimeProcess) -> None:
    bundle = bundles["discrete"]
    model = tfjs.load(str(bundle.folder / "tfjs"))

    def moved(feeds: Mapping[str, np.ndarray], fetch: Sequence[str]) -> dict[str, np.ndarray]:
        results = model.run(feeds, fetch)
        return {**results, "action_probs": results["action_probs"] + np.float32(1e-3)}

    assert any(
        text.startswith("action_probs, typical, batch 1") for text in disagreements(bundle.policy, model.run, moved)
    )
    model.unload()


def test_all_policies_of_the_fixtures_are_tried(bundles: dict[str, ExportResult]) -> None:
    assert sorted(bundles) == sorted(POLICIES)
