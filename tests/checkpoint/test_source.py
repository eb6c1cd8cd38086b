"""Checkpoints as sources: by any of their files, with a raw graph or a MetaGraph, with what may be wrong with them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import Source, read_source
from export_model.signatures.errors import ExportModelError, NotAPolicyError, SourceError, UsageError
from tests.checkpoint.writing import TrainingGraph, bundle, expected, policy

OBSERVATION = np.linspace(-1, 1, 12, dtype=np.float32).reshape(4, 3)


def only(source: Source) -> Policy:
    (found,) = source.policies()
    return found


def answer(found: Policy) -> np.ndarray:
    return run_graph(found.graph, {"state": OBSERVATION}, ["action"])["action"]


def run_of(folder: Path, steps: tuple[int, ...] = (10, 200, 30), *, meta: bool = False, op: str = "VariableV2") -> dict:
    """A run's folder with a checkpoint per step; returns step → graph."""
    graphs = {step: policy(step, op=op) for step in steps}
    for step, graph in graphs.items():
        prefix = folder / f"model-{step}.cptk"
        bundle(prefix, graph.variables)
        if meta:
            graph.write(folder / f"model-{step}.cptk.meta", meta=True)
    if not meta:
        graphs[steps[0]].write(folder / "raw_graph_def.pb")
    return graphs


@pytest.mark.parametrize("meta", [False, True])
@pytest.mark.parametrize("op", ["VariableV2", "VarHandleOp", "Variable"])
def test_every_file_of_a_checkpoint_names_it(tmp_path: Path, meta: bool, op: str) -> None:
    graphs = run_of(tmp_path, meta=meta, op=op)
    names = ["model-30.cptk", "model-30.cptk.index", "model-30.cptk.data-00000-of-00001"]
    for name in [*names, *(["model-30.cptk.meta"] if meta else [])]:
        found = only(read_source(tmp_path / name))
        assert found.name == "model-30"
        np.testing.assert_allclose(answer(found), expected(graphs[30], OBSERVATION), rtol=1e-6)
        assert found.signature.constants == {"version_number": 2}
        assert [s.name for s in found.signature.outputs] == ["action", "deterministic_action"]


def test_the_newest_is_found_by_number(tmp_path: Path) -> None:
    graphs = run_of(tmp_path / "ppo")
    # what another machine left; the folder's files decide
    (tmp_path / "ppo/checkpoint").write_text('model_checkpoint_path: "C:\\\\old\\\\model-10.cptk"\n')
    for path in (tmp_path / "ppo", tmp_path / "ppo/checkpoint", tmp_path / "ppo/raw_graph_def.pb"):
        found = only(read_source(path))
        assert found.name == "ppo"
        np.testing.assert_allclose(answer(found), expected(graphs[200], OBSERVATION), rtol=1e-6)
        assert "also here, not used: model-10.cptk, model-30.cptk" in found.signature.notes
        found = only(read_source(path, ReadOptions(step=30)))
        np.testing.assert_allclose(answer(found), expected(graphs[30], OBSERVATION), rtol=1e-6)
        with pytest.raises(UsageError, match=r"--step 31: .*\n  fix: the steps are 10, 30, 200"):
            read_source(path, ReadOptions(step=31))


def test_a_step_beside_a_named_checkpoint_is_a_contradiction(tmp_path: Path) -> None:
    run_of(tmp_path)
    assert only(read_source(tmp_path / "model-10.cptk", ReadOptions(step=10))).name == "model-10"
    with pytest.raises(UsageError, match="--step 30 goes with a folder"):
        read_source(tmp_path / "model-10.cptk", ReadOptions(step=30))


def test_the_hash_is_of_all_its_files(tmp_path: Path) -> None:
    run_of(tmp_path)
    before = read_source(tmp_path / "model-10.cptk").sha256
    assert read_source(tmp_path / "model-10.cptk.index").sha256 == before
    assert read_source(tmp_path / "model-30.cptk").sha256 != before


def test_the_original_has_the_checkpoints_values_in_place_of_its_variables(tmp_path: Path) -> None:
    run_of(tmp_path)
    source = read_source(tmp_path / "model-10.cptk")
    ((model, policy),) = source.compile_models()
    assert model.original is not None
    assert model.original.path == tmp_path / "raw_graph_def.pb"
    with model.original.loadable() as (path, _):
        given = schema.parse(schema.GraphDef, Path(path).read_bytes(), "TensorFlow graph")
    ops = {n.name: n.op for n in given.node}
    assert "Const" in ops.values()
    assert not {"VariableV2", "Assign", "RestoreV2", "SaveV2"} & set(ops.values())
    assert policy.source.fetches["action"].removesuffix(":0") in ops


def test_the_savers_names_and_slices_are_followed(tmp_path: Path) -> None:
    graph = policy()
    del graph.message.node[next(i for i, n in enumerate(graph.message.node) if n.name == "save/Const") :]
    graph.saver({"dense/kernel": "other/kernel", "dense/bias": "wide"}, {"dense/bias": "5 1,2"})
    values = dict(graph.variables)
    values["other/kernel"] = values.pop("dense/kernel")
    values["wide"] = np.concatenate([[7], values.pop("dense/bias"), [8, 9]]).astype(np.float32)
    bundle(tmp_path / "model-1.ckpt", values)
    graph.write(tmp_path / "raw_graph_def.pb")
    found = only(read_source(tmp_path))
    np.testing.assert_allclose(answer(found), expected(graph, OBSERVATION), rtol=1e-6)


def test_slots_of_the_optimizer_are_not_read(tmp_path: Path) -> None:
    """Nor missed where they are gone, as in checkpoints that were made smaller."""
    graph = policy()
    bundle(tmp_path / "model-1.ckpt", {k: v for k, v in graph.variables.items() if "Adam" not in k})
    graph.write(tmp_path / "raw_graph_def.pb")
    np.testing.assert_allclose(answer(only(read_source(tmp_path))), expected(graph, OBSERVATION), rtol=1e-6)


def test_initial_values_of_any_size_are_not_unfolded(tmp_path: Path) -> None:
    """TensorFlow 1.0 wrote zeros as one value with a shape; a large network has more of them than may be unfolded."""
    graph = policy()
    for node in graph.message.node:
        if node.name.endswith("Initializer/zeros"):
            proto = node.attr["value"].tensor
            proto.tensor_content = b""
            proto.tensor_shape.dim.add(size=1 << 23)
    bundle(tmp_path / "model-1.ckpt", graph.variables)
    graph.write(tmp_path / "raw_graph_def.pb")
    np.testing.assert_allclose(answer(only(read_source(tmp_path))), expected(graph, OBSERVATION), rtol=1e-6)


# ------------------------------------------------------------------ what the trainers named otherwise


def sampled() -> TrainingGraph:
    graph = TrainingGraph()
    f32, i32 = np.dtype(np.float32), np.dtype(np.int32)
    graph.node("vector_observation", "Placeholder", dtype=f32, shape=(-1, 3))
    kernel = graph.variable("dense/kernel", np.eye(3, dtype=np.float32), slots=False)
    graph.node("logits", "MatMul", "vector_observation", kernel, T=f32)
    graph.const("action/Multinomial/num_samples", np.array(1, np.int32))
    graph.node("action/Multinomial", "Multinomial", "logits", "action/Multinomial/num_samples", T=f32, Tseed=i32)
    graph.saver()
    return graph


def test_the_cloned_policies_of_0_3_0_have_their_action(tmp_path: Path) -> None:
    graph = sampled()
    bundle(tmp_path / "model-1.ckpt", graph.variables)
    graph.write(tmp_path / "raw_graph_def.pb")
    found = only(read_source(tmp_path))
    assert found.signature.output("action").source == "action/Multinomial:0"
    assert any("0.3.0" in note for note in found.signature.notes)


@pytest.mark.parametrize(("minor", "kept"), [(21, True), (22, False), (23, False)])
def test_action_probs_are_exported_up_to_0_21(tmp_path: Path, minor: int, kept: bool) -> None:
    graph = policy()
    for part, number in (("major", 0), ("minor", minor), ("patch", 0)):
        graph.variable(f"trainer_{part}_version", np.array(number, np.int32), slots=False)
    graph.node("action_probs", "Tanh", "biased", T=np.dtype(np.float32))
    bundle(tmp_path / "model-1.ckpt", graph.variables)
    graph.write(tmp_path / "raw_graph_def.pb")
    found = only(read_source(tmp_path))
    assert ("action_probs" in [s.name for s in found.signature.outputs]) is kept
    assert found.signature.family == f"ML-Agents 0.{minor}.0"


def test_a_graph_without_an_action_lists_few_candidates(tmp_path: Path) -> None:
    graph = policy()
    for node in graph.message.node:
        if node.name in ("action", "critic/policy/action"):
            node.name = node.name.replace("action", "choice")
        node.input[:] = [i.replace("policy/action", "policy/choice") if i != "action" else "choice" for i in node.input]
    bundle(tmp_path / "model-1.ckpt", graph.variables)
    graph.write(tmp_path / "raw_graph_def.pb")
    with pytest.raises(ExportModelError) as caught:
        read_source(tmp_path).policies()
    assert "save/" not in str(caught.value)
    assert "update" not in str(caught.value)


# ------------------------------------------------------------------ what may be wrong


def test_a_graph_of_another_network_is_refused(tmp_path: Path) -> None:
    graph = policy()
    bundle(tmp_path / "model-1.ckpt", {**graph.variables, "dense/kernel": np.zeros((5, 2), np.float32)})
    graph.write(tmp_path / "raw_graph_def.pb")
    with pytest.raises(SourceError, match=r"'dense/kernel' is float32 \[3, 2\] in the graph and float32 \[5, 2\]"):
        read_source(tmp_path)


def test_a_variable_without_a_value_is_named(tmp_path: Path) -> None:
    graph = policy()
    bundle(tmp_path / "model-1.ckpt", {k: v for k, v in graph.variables.items() if k != "dense/bias"})
    graph.write(tmp_path / "raw_graph_def.pb")
    with pytest.raises(NotAPolicyError, match="no value for the variable 'dense/bias'"):
        read_source(tmp_path)


def test_a_graph_alone_says_what_it_lacks(tmp_path: Path) -> None:
    file = policy().write(tmp_path / "raw_graph_def.pb")
    with pytest.raises(NotAPolicyError, match=r"variables and no values for them: 'dense/kernel' \(and 1 more\)"):
        read_source(file)


def test_a_checkpoint_alone_says_what_it_lacks(tmp_path: Path) -> None:
    bundle(tmp_path / "model-1.ckpt", policy().variables)
    with pytest.raises(SourceError, match="graph is missing beside the checkpoint"):
        read_source(tmp_path / "model-1.ckpt")
    (tmp_path / "checkpoint").write_text('model_checkpoint_path: "model-9"\n')
    (tmp_path / "model-1.ckpt.index").unlink()
    with pytest.raises(SourceError, match="the folder holds no checkpoint"):
        read_source(tmp_path / "checkpoint")


def test_a_metagraph_without_its_values(tmp_path: Path) -> None:
    file = policy().write(tmp_path / "model-1.ckpt.meta", meta=True)
    with pytest.raises(SourceError, match=r"model-1\.ckpt\.index: no such file"):
        read_source(file)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["model-1.ckpt.index", "model-1.ckpt.data-00000-of-00001", "raw_graph_def.pb"])
def test_damage_leaves_nothing_behind(tmp_path: Path, name: str) -> None:
    """Every byte cut off, or changed, one by one: a clear error or the same policy."""
    whole, broken, out = tmp_path / "whole", tmp_path / "broken", tmp_path / "out"
    graph = sampled() if name == "raw_graph_def.pb" else policy()
    bundle(whole / "model-1.ckpt", graph.variables)
    graph.write(whole / "raw_graph_def.pb")
    shutil.copytree(whole, broken)
    content = (whole / name).read_bytes()
    for position in range(0, len(content), max(len(content) // 60, 1)):
        changed = bytes([content[position] ^ 0x55])
        for damaged in (content[:position], content[:position] + changed + content[position + 1 :]):
            (broken / name).write_bytes(damaged)
            try:
                list(export([broken], ExportOptions(out, verify="none")))
            except ExportModelError as error:
                assert error.exit_status == 2
                assert "broken" in str(error)
                assert not out.exists() or not list(out.iterdir())
            else:
                shutil.rmtree(out)
