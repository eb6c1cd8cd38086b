"""``--bake actions``: the graph computes what is stated, once; whatever applies it twice is found."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from export_model.converters.compiler.passes import bake
from export_model.signatures.contract import POLICY
from tests.commands import Ran, export_model
from tests.interfaces.made import SEEN, mjlab, run_with

ort = pytest.importorskip("onnxruntime")
SCALE, OFFSET = np.array([0.25, 0.5], np.float32), np.array([0.4, -0.8], np.float32)
LOW, HIGH = np.array([-1.0, -2.5], np.float32), np.array([1.0, 1.0], np.float32)
RAW = 4.0


def baked(folder: Path, *options: object) -> Ran:
    """A run with deploy.yaml and agent.yaml, exported with its action baked."""
    path = run_with(folder, "deploy.yaml", "agent.yaml")
    return export_model(path, "-o", folder / "out", "--bake", "actions", *options)


def run(path: Path, given: np.ndarray, output: str) -> np.ndarray:
    session = ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (answer,) = session.run([output], {session.get_inputs()[0].name: given})
    return np.asarray(answer)


def observed(rows: int = 64) -> np.ndarray:
    return np.random.default_rng(1).normal(0, 6, (rows, SEEN)).astype(np.float32)


def as_stated(actions: np.ndarray) -> np.ndarray:
    """What deploy.yaml and agent.yaml say, in numpy."""
    return np.clip(np.clip(actions, -RAW, RAW) * SCALE + OFFSET, LOW, HIGH)


def test_the_graph_computes_scale_offset_and_both_clips(tmp_path: Path) -> None:
    assert baked(tmp_path, "--verify", "onnxruntime").status == 0
    own = run(tmp_path / "exported" / "policy.onnx", observed(), "actions")
    assert (np.abs(own) > RAW).any()
    for name in ("action", "deterministic_action"):
        ours = run(tmp_path / "out" / "policy" / "policy.onnx", observed(), name)
        assert (ours == LOW).any() or (ours == HIGH).any()
        np.testing.assert_allclose(ours, as_stated(own), rtol=1e-6, atol=1e-6)


def test_it_is_said_once(tmp_path: Path) -> None:
    assert baked(tmp_path, "--verify", "none", "--to", "onnx").status == 0
    contract = json.loads((tmp_path / "out" / "policy" / POLICY).read_text())
    interface = contract["interface"]
    assert contract["tool"]["bake"] == "actions"
    assert [t["name"] for t in interface["baked"]] == ["raw action", "JointPositionAction"]
    assert not {"scale", "offset", "clip"} & interface["actions"][0].keys()
    assert "limits" not in interface
    told = export_model("snippets", tmp_path / "out" / "policy", "--for", "onnxruntime").out
    assert "in the graph already, apply nothing" in told


def test_baked_metadata_is_not_written_where_robots_would_apply_it_again(tmp_path: Path) -> None:
    path = mjlab(tmp_path, "Mjlab-Lift-Cube-Yam")
    assert (
        export_model(path, "-o", tmp_path / "out", "--bake", "actions", "--to", "onnx", "--verify", "none").status == 0
    )
    model = onnx.load(tmp_path / "out" / "policy" / "policy.onnx")
    assert not any(p.key == "action_scale" for p in model.metadata_props)


def test_a_second_bake_has_nothing_to_do_and_says_so(tmp_path: Path) -> None:
    assert baked(tmp_path, "--verify", "none").status == 0
    first = tmp_path / "out" / "policy"
    ran = export_model(first, "-o", tmp_path / "again", "--bake", "actions", "--to", "onnx", "--verify", "none")
    assert ran.status == 0 and "had nothing to do" in ran.out
    again = tmp_path / "again" / "policy" / "policy.onnx"
    np.testing.assert_array_equal(run(again, observed(), "action"), run(first / "policy.onnx", observed(), "action"))


def test_every_format_agrees_and_the_source_is_baked_anew(tmp_path: Path) -> None:
    ran = baked(tmp_path, "--to", "bytes,onnx,tfjs,litert", "--verify", "onnxruntime,tfjs-cpu,litert")
    assert ran.status == 0, ran.out
    source = tmp_path / "exported" / "policy.onnx"
    ran = export_model("verify", tmp_path / "out", "--source", source, "--runtimes", "onnxruntime")
    assert ran.status == 0 and "agrees with the original in onnxruntime" in ran.out


def test_nothing_stated_or_a_consumer_is_refused(tmp_path: Path) -> None:
    path = run_with(tmp_path)
    ran = export_model(path, "-o", tmp_path / "out", "--bake", "actions")
    assert ran.status == 2 and "states a scale" in ran.err
    ran = baked(tmp_path, "--for", "unity6")
    assert ran.status == 2 and "does not go with --for" in ran.err
    ran = baked(tmp_path, "--env", "3DBall")
    assert ran.status == 2 and "does not go with --bake" in ran.err


# ------------------------------------------------------------------ planted: applied twice


def _behind(path: Path, op: str, value: np.ndarray) -> None:
    """Apply ``op`` with a constant once more behind the outputs of an ONNX."""
    model = onnx.load(path)
    for output in ("action", "deterministic_action"):
        for node in model.graph.node:
            node.output[:] = [f"{o}_once" if o == output else o for o in node.output]
            node.input[:] = [f"{i}_once" if i == output else i for i in node.input]
        model.graph.initializer.append(numpy_helper.from_array(value, f"{output}_value"))
        model.graph.node.append(helper.make_node(op, [f"{output}_once", f"{output}_value"], [output]))
    onnx.save(model, path)


def _before(path: Path, value: float) -> None:
    """Apply a scale once more to what is observed."""
    model = onnx.load(path)
    for node in model.graph.node:
        node.input[:] = ["state_twice" if i == "state" else i for i in node.input]
    model.graph.initializer.append(numpy_helper.from_array(np.float32(value), "twice"))
    model.graph.node.insert(0, helper.make_node("Mul", ["state", "twice"], ["state_twice"]))
    onnx.save(model, path)


def _rehash(folder: Path, name: str) -> None:
    """Let the contract have the hash of a file that was changed, as a tool that changed it would."""
    import hashlib

    data = (folder / name).read_bytes()
    content = json.loads((folder / POLICY).read_text())
    content["files"][name] = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
    (folder / POLICY).write_text(json.dumps(content))


@pytest.mark.parametrize("fault", ["scale", "offset", "observation"])
def test_verify_finds_what_a_file_applies_twice(tmp_path: Path, fault: str) -> None:
    assert baked(tmp_path, "--to", "bytes,onnx", "--verify", "none").status == 0
    folder = tmp_path / "out" / "policy"
    assert export_model("verify", folder, "--runtimes", "onnxruntime").status == 0
    if fault == "observation":
        _before(folder / "policy.onnx", 0.2)
    else:
        _behind(folder / "policy.onnx", *{"scale": ("Mul", SCALE), "offset": ("Add", OFFSET)}[fault])
    _rehash(folder, "policy.onnx")
    ran = export_model("verify", folder, "--runtimes", "onnxruntime")
    assert ran.status == 1 and "action" in ran.out


WRONG = {
    "another scale": lambda step: bake._Step(step.clip, [1.1 * x for x in step.scale], step.offset),
    "no offset": lambda step: bake._Step(step.clip, step.scale),
    "no clip": lambda step: bake._Step([(None, None)] * len(step.scale), step.scale, step.offset),
    "joints exchanged": lambda step: bake._Step(step.clip[::-1], step.scale[::-1], step.offset[::-1]),
}


@pytest.mark.parametrize("runtimes", ["onnxruntime", "node"])
@pytest.mark.parametrize("fault", WRONG)
def test_a_wrong_bake_is_found(fault: str, runtimes: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All files have it alike: by the source's own action, or by our kernels', with what is stated applied apart."""
    made = bake._whole
    monkeypatch.setattr(bake, "_whole", lambda terms, width: WRONG[fault](made(terms, width)))
    ran = baked(tmp_path, "--to", "bytes,onnx,js", "--verify", runtimes)
    assert ran.status == 1
    assert "action differs by" in ran.out


def test_a_baked_bundle_is_judged_by_its_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as planted:
        made = bake._whole
        planted.setattr(bake, "_whole", lambda terms, width: WRONG["no clip"](made(terms, width)))
        assert baked(tmp_path, "--to", "bytes,onnx", "--verify", "none").status == 0
    source = tmp_path / "exported" / "policy.onnx"
    ran = export_model("verify", tmp_path / "out", "--source", source, "--runtimes", "onnxruntime")
    assert ran.status == 1 and "action differs by" in ran.out


def _log(folder: Path, action: np.ndarray, state: np.ndarray) -> Path:
    path = folder / "log.npz"
    np.savez(path, state=state, action=action)
    return path


@pytest.mark.parametrize("fault", ["scale", "offset", "observation"])
def test_a_log_shows_what_the_caller_applied_twice(tmp_path: Path, fault: str) -> None:
    assert baked(tmp_path, "--to", "bytes,onnx", "--verify", "none").status == 0
    folder = tmp_path / "out" / "policy"
    state = np.random.default_rng(2).normal(0, 1, (200, SEEN)).astype(np.float32)
    action = run(folder / "policy.onnx", state, "deterministic_action")
    clean = export_model("verify", folder, "--log", _log(tmp_path, action, state))
    assert clean.status == 0, clean.out + clean.err
    if fault == "scale":
        action = action * SCALE
    elif fault == "offset":
        action = action + OFFSET
    else:
        fed = state.copy()
        fed[:, :3] *= 0.2  # base_ang_vel's scale, once more
        action = run(folder / "policy.onnx", fed, "deterministic_action")
    ran = export_model("verify", folder, "--log", _log(tmp_path, action, state), "--json")
    assert ran.status == 1
    assert {"scale": "action_scale", "offset": "action_offset", "observation": "stated_scale"}[fault] in ran.out


def test_a_contract_that_hides_what_is_baked_is_found(tmp_path: Path) -> None:
    """policy.json says that the action is yet to be scaled; the graph scales it."""
    assert baked(tmp_path, "--to", "bytes,onnx", "--verify", "none").status == 0
    folder, other = tmp_path / "out" / "policy", tmp_path / "other"
    path = tmp_path / "exported" / "policy.onnx"
    assert export_model(path, "-o", other, "--to", "bytes,onnx", "--verify", "none").status == 0
    content = json.loads((folder / POLICY).read_text())
    content["interface"] = json.loads((other / "policy" / POLICY).read_text())["interface"]
    del content["tool"]["bake"]
    shutil.copy(folder / POLICY, folder / "policy.json.bak")
    (folder / POLICY).write_text(json.dumps(content))
    (folder / "policy.json.bak").unlink()
    ran = export_model("verify", folder, "--source", path, "--runtimes", "onnxruntime")
    assert ran.status in (1, 2), ran.out


def test_a_file_that_was_not_read_is_named_where_it_was_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """deploy.yaml states the scale; without PyYAML the answer must not be that nothing does."""
    monkeypatch.setitem(sys.modules, "yaml", None)
    ran = baked(tmp_path, "--verify", "none")
    assert ran.status == 2
    for words in ("nothing that was read states", "deploy.yaml", "PyYAML is not installed", "export-model[robots]"):
        assert words in ran.err
