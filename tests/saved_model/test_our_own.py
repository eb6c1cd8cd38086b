"""What this tool wrote is read back as what it was: bundles, their .bytes, SavedModels and TensorFlow.js models."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.compiler.passes.weights import Storage
from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.embed import runnable
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.formats.saved_model.artifact import graph
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, ExportResult, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.contract import EMBEDDED, Contract, Origin, safe_name
from export_model.signatures.errors import BundleError, DamagedFileError, ExportModelError
from export_model.signatures.roles import Role
from export_model.signatures.sampling import draw_cases
from fixtures import FIXTURES, FOLDER
from fixtures import path as fixture
from tests import known
from tests.corpus.conftest import frozen_corpus, genuine_cases

FORMS = ("", "{name}.bytes", "saved_model", "saved_model/saved_model.pb", "tfjs", "tfjs/model.json")
WITHOUT_ONNX = ("bytes", "saved_model", "tfjs")


def told(policy: Policy) -> dict[str, Any]:
    """The contract, but for the source's names of the tensors: the artefact is the source now."""
    content = policy.signature.to_dict()
    for entry in (*content["inputs"], *content["outputs"]):
        del entry["source"]
    return {"name": policy.name, **content}


def assert_same(got: Policy, wanted: Policy) -> None:
    assert told(got) == told(wanted)
    names = [s.name for s in wanted.signature.outputs if s.role is not Role.SAMPLED]
    for case in draw_cases(wanted.signature, seed=1, samples=1):
        one, two = (run_graph(p.graph, case.feeds, names) for p in (got, wanted))
        for name in names:
            assert one[name].dtype == two[name].dtype
            np.testing.assert_allclose(one[name], two[name], rtol=1e-6, atol=1e-6, err_msg=name)


def exported(name: str, out: Path) -> list[ExportResult]:
    return list(export([fixture(f"{name}.bytes")], ExportOptions(out, verify="none")))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", FIXTURES)
def test_the_contract_is_kept(name: str, form: str, tmp_path: Path) -> None:
    for result in exported(name, tmp_path):
        place = result.folder / form.format(name=result.policy.name)
        (policy,) = read_source(place).policies()
        assert_same(policy, result.policy)
        assert policy.source.feeds.keys() == result.policy.source.feeds.keys()
        assert set(policy.source.feeds.values()) == {f"{s.name}:0" for s in policy.signature.inputs}


@pytest.mark.parametrize("source", ["recurrent.bytes", "sb3_zip/ppo_box.zip", "torch_checkpoint/ppo_0_22_lstm.pt"])
@pytest.mark.parametrize("weights", ["float32", "float16"])
def test_what_is_written_for_converters_is_the_same_to_the_bit(source: str, weights: Storage, tmp_path: Path) -> None:
    """Biases that are subtracted, sums of two products, one-hot rows; read back, biases are added again."""
    options = ExportOptions(tmp_path, targets=WITHOUT_ONNX, verify="none", weights=weights)
    (result,) = export([FOLDER / source], options)
    whole = read_graph((result.folder / f"{result.policy.name}.bytes").read_bytes())
    written = graph(result.folder / "saved_model")
    assert [n.op for n in written.nodes] != [n.op for n in whole.nodes]
    names = [s.name for s in result.policy.signature.outputs if s.role is not Role.SAMPLED]
    for case in draw_cases(result.policy.signature, seed=1, samples=1):
        one, two = (run_graph(runnable(g), case.feeds, names) for g in (whole, written))
        for name in names:
            np.testing.assert_array_equal(one[name], two[name])
    if weights == "float32":
        (again,) = read_source(result.folder / "saved_model").policies()
        assert not {n.op for n in again.graph.nodes} & {"Sub"} - {n.op for n in whole.nodes}


def test_a_graph_of_ours_with_an_input_lost_or_a_number_in_place_of_a_kernel_is_refused_by_its_node(
    tmp_path: Path,
) -> None:
    """Where biases are added again nothing has been looked at yet: how many inputs, and of which rank."""
    (result,) = export(
        [FOLDER / "sb3_zip/ppo_box.zip"], ExportOptions(tmp_path, targets=("saved_model",), verify="none")
    )
    file = result.folder / "saved_model" / "saved_model.pb"
    whole = file.read_bytes()
    ops = [n.op for n in schema.parse(schema.SavedModel, whole, "model").meta_graphs[0].graph_def.node]
    assert {"Sub", "MatMul"} <= set(ops)
    for number, op in enumerate(ops):
        if op not in ("Sub", "MatMul", "Const"):
            continue
        model = schema.parse(schema.SavedModel, whole, "model")
        node = model.meta_graphs[0].graph_def.node[number]
        if op != "Const":
            del node.input[0]
        elif len(node.attr["value"].tensor.tensor_shape.dim) == 2:
            node.attr["value"].tensor.CopyFrom(schema.TensorProto(dtype=node.attr["dtype"].type, float_val=[0.5]))
            node.attr["value"].tensor.tensor_shape.SetInParent()
        else:
            continue
        file.write_bytes(schema.serialise(model))
        with pytest.raises(ExportModelError) as refused:
            read_source(file).policies()
        assert "did not expect" not in str(refused.value), (node.name, refused.value)


@pytest.mark.corpus
@pytest.mark.slow
def test_the_contract_of_every_kind_of_public_and_genuine_graph_is_kept(
    tmp_path: Path, is_new: Callable[[str, Sequence[Policy]], bool]
) -> None:
    """A policy that has nothing which none before had is left out, unless EXPORT_MODEL_TEST_FULL=1 asks for all."""
    sources = frozen_corpus() + [f / c["frozen"]["file"] for f, c in genuine_cases()]
    if not sources:
        pytest.skip("../shared (public models, genuine graphs) is not beside this checkout")
    found = [policy for source in sources for policy in known.policies_of(source)]
    assert len(found) >= 125
    kinds = [replace(policy, name=safe_name(policy.name)) for policy in found if is_new("contract", [policy])]
    assert len(kinds) >= 20
    for number, policy in enumerate(kinds):
        origin, tool = Origin("frozen_graph_def.pb", "0" * 64), {"name": "n", "version": "0"}
        text = Contract(policy.name, policy.signature, origin, policy.source, tool).compact()
        for target in WITHOUT_ONNX:
            artifact, folder = WRITTEN[target].artifact(policy, WriteOptions(text)), tmp_path / f"{number}-{target}"
            artifact.write(folder)
            (again,) = read_source(folder / artifact.main).policies()
            assert_same(again, policy)


@pytest.mark.slow
@pytest.mark.parametrize("first", [*WITHOUT_ONNX])
@pytest.mark.parametrize("second", [*WITHOUT_ONNX])
@pytest.mark.parametrize("name", ["sampled", "recurrent", "visual"])
def test_chains_of_formats_end_where_they_began(name: str, first: str, second: str, tmp_path: Path) -> None:
    (start,) = exported(name, tmp_path / "0")
    place = {"bytes": f"{name}.bytes", "saved_model": "saved_model", "tfjs": "tfjs"}
    options = ExportOptions(tmp_path / "1", verify="none")
    (middle,) = export([start.folder / place[first]], options)
    (end,) = export([middle.folder / place[second]], ExportOptions(tmp_path / "2", verify="none"))
    assert_same(end.policy, start.policy)


def test_other_options_still_apply(tmp_path: Path) -> None:
    from export_model.converters.compiler.options import CompileOptions

    (start,) = exported("continuous", tmp_path / "0")
    options = CompileOptions(deterministic=True)
    (end,) = export([start.folder], ExportOptions(tmp_path / "1", verify="none", compile=options))
    assert [s.name for s in end.policy.signature.inputs] == ["state"]


#: One runtime for each format: what reads a form back is told apart, and the originals are run.
ONE_EACH = ("tensorflow", "onnxruntime", "tfjs-wasm")


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_verifies_against_itself(form: str, tmp_path: Path, pool: RuntimePool) -> None:
    for name in ("recurrent", "sampled", "twobrains"):
        for start in exported(name, tmp_path / "0"):
            place = start.folder / form.format(name=start.policy.name)
            (result,) = export([place], ExportOptions(tmp_path / "1", verify=ONE_EACH), pool=pool)
            assert result.report is not None
            assert result.report.passed is True, "\n".join(failure_lines(result.report))
            if "tfjs" not in form:
                assert result.report.reference == "source/tensorflow"


# ------------------------------------------------------------------ what may be wrong


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return exported("continuous", tmp_path)[0].folder


def test_a_bundle_gives_what_it_has(bundle: Path) -> None:
    content = json.loads((bundle / "policy.json").read_text())
    for gone, read in (("continuous.bytes", "saved_model.pb"), ("saved_model", "model.json")):
        for path in [p for p in content["files"] if p.startswith(gone)]:
            del content["files"][path]
        (bundle / "policy.json").write_text(json.dumps(content))
        source = read_source(bundle)
        assert read in {f.name for f in source.models[0].files}
        assert source.policies()[0].name == "continuous"


def test_a_changed_bundle_is_refused(bundle: Path) -> None:
    file = bundle / "continuous.bytes"
    file.write_bytes(file.read_bytes() + b"\0")
    with pytest.raises(BundleError, match=r"continuous\.bytes: has been changed"):
        read_source(bundle)
    file.unlink()
    with pytest.raises(BundleError, match=r"continuous\.bytes: is missing"):
        read_source(bundle)


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        "{}",
        '{"name": "a"}',
        '{"name": "../x", "files": {}}',
        '{"name": "a", "files": {}}',
        '{"name": "a", "files": {"a.bytes": 3}}',
        '{"name": "continuous", "files": {"continuous.bytes": {"sha256": "0"}}}',
    ],
)
def test_a_policy_json_that_is_none(bundle: Path, content: str) -> None:
    (bundle / "policy.json").write_text(content)
    with pytest.raises(BundleError) as caught:
        read_source(bundle)
    assert str(bundle) in str(caught.value)


def test_a_contract_that_cannot_be_read(bundle: Path) -> None:
    graph = schema.parse(schema.GraphDef, (bundle / "continuous.bytes").read_bytes(), "graph")
    for text in ("{", "{}", "3", '{"name": 3, "inputs": [], "outputs": []}'):
        for node in graph.node:
            if node.name == EMBEDDED:
                node.attr["value"].tensor.string_val[:] = [text.encode()]
        file = bundle / "other.bytes"
        file.write_bytes(schema.serialise(graph))
        with pytest.raises(DamagedFileError, match="contract that it embeds cannot be read"):
            read_source(file)


def test_damage_of_every_file_leaves_nothing_behind(bundle: Path, tmp_path: Path) -> None:
    out, broken = tmp_path / "out", tmp_path / "broken"
    for relative in ("saved_model/saved_model.pb", "tfjs/model.json", "tfjs/group1-shard1of1.bin", "policy.json"):
        content = (bundle / relative).read_bytes()
        place = broken if relative == "policy.json" else broken / relative.split("/")[0]
        for position in range(0, len(content), max(len(content) // 25, 1)):
            shutil.rmtree(broken, ignore_errors=True)
            shutil.copytree(bundle, broken)
            (broken / relative).write_bytes(content[:position])
            try:
                list(export([place], ExportOptions(out, verify="none")))
            except ExportModelError as error:
                assert error.exit_status == 2
            assert not out.exists() or {p.name for p in out.iterdir()} <= {"continuous"}
