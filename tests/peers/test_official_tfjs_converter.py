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

from converters.runtimes.pool import RuntimePool
from converters.runtimes.process import RuntimeProcess
from converters.runtimes.registry import available_runtimes
from exporter.export.pipeline import ExportResult
from tests.peers.agreement import POLICIES, disagreements
from tests.peers.environment import Peers

pytestmark = [pytest.mark.slow, pytest.mark.peers, pytest.mark.xdist_group("peers")]


@pytest.fixture(scope="module")
def tfjs(processes: RuntimePool) -> RuntimeProcess:
    info = next(i for i in available_runtimes() if i.name == "tfjs-cpu")
    if not info.installed:
        pytest.skip(f"TensorFlow.js is not installed: {info.how}")
    return processes.process("tfjs-cpu")


def convert(peers: Peers, bundle: ExportResult, out: Path, *options: str) -> dict[str, Any]:
    """Convert, and return the model.json."""
    source = str(bundle.folder / "saved_model")
    peers.run([*peers.tensorflowjs_converter(), "--input_format=tf_saved_model", *options, source, str(out)])
    model: dict[str, Any] = json.loads((out / "model.json").read_text(encoding="utf-8"))
    return model


def nodes(entries: dict[str, dict[str, str]]) -> set[str]:
    """The nodes that a signature's entries stand for."""
    return {entry["name"].removesuffix(":0") for entry in entries.values()}


@pytest.mark.parametrize("name", POLICIES)
def test_its_model_agrees_with_ours(
    name: str, tmp_path: Path, peers: Peers, bundles: dict[str, ExportResult], tfjs: RuntimeProcess
) -> None:
    bundle = bundles[name]
    model = convert(peers, bundle, tmp_path / "theirs")
    signature = bundle.policy.signature
    assert nodes(model["signature"]["inputs"]) == {s.name for s in signature.inputs}
    assert nodes(model["signature"]["outputs"]) == {s.name for s in signature.outputs}
    ours, theirs = tfjs.load(str(bundle.folder / "tfjs")), tfjs.load(str(tmp_path / "theirs"))
    assert not disagreements(bundle.policy, ours.run, theirs.run)
    ours.unload()
    theirs.unload()


def test_the_signature_without_noise_goes_through_too(
    tmp_path: Path, peers: Peers, bundles: dict[str, ExportResult], tfjs: RuntimeProcess
) -> None:
    bundle = bundles["continuous"]
    model = convert(peers, bundle, tmp_path / "theirs", "--signature_name=deterministic")
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
