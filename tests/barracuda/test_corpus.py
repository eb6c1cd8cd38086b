"""Every public ``.nn`` becomes one policy, and that policy is written in all four formats."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.formats.barracuda.format import parse
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.run import run_graph
from export_model.exporter.export.sources import read_source
from export_model.signatures.roles import Role
from tests.barracuda.conftest import SHARED, params, public_files

pytestmark = pytest.mark.corpus


@pytest.mark.parametrize("path", params(public_files(), lambda p: p.name[:70]))
def test_a_public_model_compiles_and_is_written_in_four_formats(path: Path, shared: Path) -> None:
    source = read_source(path)
    assert source.format.key == "nn"
    (policy,) = source.policies()
    signature, model = policy.signature, parse(path.read_bytes())
    given = {i.name: i.shape for i in model.inputs}

    for spec in signature.inputs:
        if spec.role is Role.MEMORY_IN:
            assert spec.source == tuple(m.input for m in model.memories)
            assert spec.shape == (None, sum(m.shape[3] for m in model.memories))
        elif isinstance(spec.source, str) and spec.source in given:
            _, h, w, c = given[spec.source]
            assert spec.shape == ((None, c) if (h, w) == (1, 1) else (None, h, w, c))
        else:
            assert spec.role is Role.NOISE
        assert spec.dtype == ("int32" if spec.name == "prev_action" else "float32")
    assert signature.output("action").source == "action"
    assert signature.action_space == ("continuous" if signature.constants["is_continuous_control"] else "discrete")
    assert signature.output("action").shape == (None, signature.constants["action_output_shape"])
    preview = model.number("version_number") == 1
    assert (signature.family == "ML-Agents 0.7 (preview)") == preview
    assert preview or model.version == 16
    if model.memories:
        assert signature.memory is not None
        assert signature.memory.layout == ("c", "h") * (len(model.memories) // 2)
    assert any("self-consistent" in note for note in signature.notes)

    rng = np.random.default_rng(0)
    feeds = {}
    for spec in signature.inputs:
        shape = [5 if d is None else d for d in spec.shape]
        feeds[spec.name] = rng.uniform(0, 1, shape).astype(spec.dtype)
        if spec.role is Role.MASKS:
            feeds[spec.name] = np.ones(shape, np.float32)
    for name, value in run_graph(policy.graph, feeds, [s.name for s in signature.outputs]).items():
        assert np.isfinite(value).all(), name
    for target in WRITTEN:
        artifact = WRITTEN[target].artifact(policy, WriteOptions(json.dumps(signature.to_dict())))
        assert artifact.files


def test_the_corpus_is_whole(shared: Path) -> None:
    """57 public .nn and one under the name .bytes, so that nothing falls out of the tests unseen."""
    assert len(public_files()) == 58


def test_the_facts_of_the_manifest_are_found(shared: Path) -> None:
    """Names and constants that another parser found in the same files."""
    lines = [json.loads(line) for line in (SHARED / "corpus/manifest.jsonl").read_text().splitlines()]
    entries = [entry for entry in lines if entry["kind"] == "nn"]
    assert entries
    for entry in entries:
        model = parse((SHARED / "corpus" / entry["file"]).read_bytes())
        facts = entry["facts"]
        assert model.version == facts.get("version", model.version)
        if "inputs" in facts:
            assert [i.name for i in model.inputs] == [i["name"] for i in facts["inputs"]]
