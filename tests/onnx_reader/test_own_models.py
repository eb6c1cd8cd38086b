"""What this tool writes as ONNX is read back as what it was: names, roles, facts and numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.onnx.writer import write
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.contract import EMBEDDED, Contract, Origin
from export_model.signatures.errors import DamagedFileError
from export_model.signatures.roles import Role
from export_model.signatures.sampling import draw_cases
from fixtures import FIXTURES, path
from tests.onnx_reader.mlagents import policy as mlagents
from tests.onnx_reader.models import Bench, save

pytestmark = pytest.mark.xdist_group("onnx-policies")

ORIGIN = Origin("source", "0" * 64)
TOOL = {"name": "export-model", "version": "0"}


def written(policy: Policy, folder: Path, opset: int = 15) -> Path:
    (data,) = write(
        policy, WriteOptions(Contract(policy.name, policy.signature, ORIGIN, policy.source, TOOL).compact(), opset)
    ).values()
    place = folder / f"{policy.name}-{opset}.onnx"
    data.write(place)
    return place


def facts(policy: Policy) -> dict[str, Any]:
    """The contract without the names that the source had."""
    content = policy.signature.to_dict()
    for spec in (*content["inputs"], *content["outputs"]):
        del spec["source"]
    return content


def same_numbers(a: Policy, b: Policy) -> None:
    outputs = [s.name for s in a.signature.outputs if s.role is not Role.SAMPLED]
    for case in draw_cases(a.signature):
        first, second = (run_graph(p.graph, case.feeds, outputs) for p in (a, b))
        for name in outputs:
            np.testing.assert_allclose(first[name], second[name], atol=1e-6, rtol=1e-6, err_msg=name)


@pytest.mark.parametrize("opset", [13, 15, 18, 21])
@pytest.mark.parametrize("name", FIXTURES)
def test_read_back(name: str, opset: int, tmp_path: Path) -> None:
    for policy in read_source(path(name)).policies():
        (again,) = read_source(written(policy, tmp_path, opset)).policies()
        assert facts(again) == facts(policy)
        assert [s.source for s in again.signature.inputs] == [s.name for s in again.signature.inputs]
        same_numbers(policy, again)


@pytest.mark.parametrize("version", ["0.20", "0.25", "0.28"])
@pytest.mark.parametrize("names", ["canonical", "source"])
def test_torch_generations_read_back(version: str, names: str, tmp_path: Path) -> None:
    options = CompileOptions(names=names)
    source = save(mlagents(version, continuous=True, recurrent=version == "0.25"), tmp_path)
    (policy,) = read_source(source).policies(options)
    (again,) = read_source(written(policy, tmp_path)).policies(options)
    assert facts(again) == facts(policy)
    same_numbers(policy, again)


def test_a_hybrid_policy_reads_back(tmp_path: Path) -> None:
    source = save(mlagents("0.28", continuous=True, branches=[3, 2], recurrent=True), tmp_path)
    (policy,) = read_source(source).policies()
    (again,) = read_source(written(policy, tmp_path)).policies()
    assert facts(again) == facts(policy)
    assert again.signature.action_space == "hybrid"


def test_ours_is_compared_with_itself_by_onnxruntime(bench: Bench, tmp_path: Path) -> None:
    (policy,) = read_source(path("recurrent")).policies()
    (result,) = export([written(policy, tmp_path)], ExportOptions(tmp_path / "out", verify=("onnxruntime",)))
    assert result.report is not None
    assert result.report.reference == "source/onnxruntime"
    assert result.report.passed is True, "\n".join(failure_lines(result.report))


@pytest.mark.parametrize("text", ["", "{", "[]", '{"name": 1}', '{"name": "x", "inputs": [{}]}'])
def test_a_contract_that_is_none_is_refused(text: str, tmp_path: Path) -> None:
    message = mlagents("0.28", continuous=True)
    message.metadata_props.add(key=EMBEDDED, value=text)
    with pytest.raises(DamagedFileError, match="contract"):
        read_source(save(message, tmp_path))


@pytest.mark.parametrize("key", [EMBEDDED, "author"])
def test_metadata_that_says_something_twice_is_refused_as_onnx_does(key: str, tmp_path: Path) -> None:
    message = mlagents("0.28", continuous=True)
    message.metadata_props.add(key=key, value="{}")
    if key != EMBEDDED:
        assert read_source(save(message, tmp_path)).policies()
    message.metadata_props.add(key=key, value="{}")
    with pytest.raises(onnx.checker.ValidationError, match="duplicate keys in metadata_props"):
        onnx.checker.check_model(message)
    with pytest.raises(DamagedFileError, match=f"its metadata has '{key}' twice"):
        read_source(save(message, tmp_path))


def test_other_metadata_is_nothing_to_us(tmp_path: Path) -> None:
    message = mlagents("0.28", continuous=True)
    message.metadata_props.add(key="author", value=json.dumps({"name": "x"}))
    assert read_source(save(message, tmp_path)).policies()
