"""Sessions, functions and Keras models of a training script: all formats compute what TensorFlow computed there."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import UsageError
from tests.commands import files_in, python
from tests.exporting import export_model
from tests.live.conftest import Trained

pytestmark = pytest.mark.xdist_group("live")

OBSERVED, MASKED = {"state": "vector_observation"}, {"state": "vector_observation", "action_masks": "masks"}
NOISY, LSTM = {**OBSERVED, "epsilon": "noise"}, {**OBSERVED, "recurrent_in": "memory_in"}
STEERED, CHOSEN = {"action": "continuous"}, {"action": "log_probs"}
JUDGED, REMEMBERED = {**STEERED, "value_estimate": "value_estimate"}, {**STEERED, "recurrent_out": "memory_out"}
#: Case of tests/live/train.py → the policy's name, what stands for the path, roles of inputs and outputs.
CASES = {
    "continuous": ("policy", "live session", NOISY, JUDGED),
    "resources": ("resources", "live session", NOISY, JUDGED),
    "discrete": ("policy", "live session", MASKED, CHOSEN),
    "recurrent-loops_of_1": ("policy", "live session", LSTM, REMEMBERED),
    "loop": ("policy", "live session", OBSERVED, STEERED),
    "hints": ("policy", "live session", OBSERVED, STEERED),
    "function": ("act", "live tf.function", MASKED, CHOSEN),
    "concrete": ("steering", "live tf.function", OBSERVED, STEERED),
    "keras": ("walker", "live Keras model", OBSERVED, JUDGED),
}


def arrays(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """(what was fed, what TensorFlow computed); the sequence's length is no input of an exported policy."""
    with np.load(folder / "case.npz") as kept:
        sides: tuple[dict[str, np.ndarray], dict[str, np.ndarray]] = ({}, {})
        for key in kept.files:
            side, name = key.split("/", 1)
            sides[side == "out"][name] = kept[key]
    sides[0].pop("sequence_length", None)
    return sides


def answers(
    pool: RuntimePool, bundle: Path, feeds: dict[str, np.ndarray], wanted: list[str]
) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """Every format's answer: ONNX by onnxruntime, the others by TensorFlow."""
    name = json.loads((bundle / "policy.json").read_text())["name"]
    onnx = pool.process("onnxruntime").load(str(bundle / f"{name}.onnx"))
    yield "onnx", onnx.run(feeds, wanted)
    graph = pool.process("tensorflow").load(str(bundle / f"{name}.bytes"), kind="graph")
    yield "bytes", graph.run(feeds, wanted)
    saved = pool.process("tensorflow").load(str(bundle / "saved_model"), kind="saved_model")
    yield "saved_model", saved.run(feeds, wanted)


def only(path: Path) -> Policy:
    (policy,) = read_source(path).policies()
    return policy


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_every_format_computes_what_tensorflow_did(trained: Trained, case: str, processes: RuntimePool) -> None:
    name, _, _, _ = CASES[case]
    folder = trained(case)
    feeds, wanted = arrays(folder)
    for kind, answer in answers(processes, folder / "out" / name, feeds, list(wanted)):
        for output, value in wanted.items():
            np.testing.assert_allclose(answer[output], value, rtol=1e-5, atol=1e-6, err_msg=f"{kind}: {output}")


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_contract_says_what_it_came_from(trained: Trained, case: str) -> None:
    name, label, inputs, outputs = CASES[case]
    bundle = trained(case) / "out" / name
    content = json.loads((bundle / "policy.json").read_text())
    assert (content["name"], content["source"]["path"]) == (name, label)
    assert len(content["source"]["sha256"]) == 64
    assert {e["name"]: e["role"] for e in content["inputs"]} == inputs
    made = ("deterministic_action", "action_log_probs")
    assert {e["name"]: e["role"] for e in content["outputs"] if e["name"] not in made} == outputs
    assert only(bundle).name == name
    parity = json.loads((bundle / "parity.json").read_text())
    assert (parity["passed"], parity["reference"]) == (True, "source/tensorflow")


@pytest.mark.slow
def test_another_process_writes_the_same_bytes(trained: Trained, tmp_path: Path) -> None:
    ran = python("-m", "tests.live.train", tmp_path, "function")
    assert ran.status == 0, ran.err[-3000:]
    one, two = (folder / "out/act" for folder in (trained("function"), tmp_path / "function"))
    assert files_in(one) == files_in(two)
    for file in sorted(files_in(one) - {"parity.json"}):
        assert not (one / file).is_file() or (one / file).read_bytes() == (two / file).read_bytes(), file


REFUSED = {
    "no session": ("UsageError", "must be a tf.compat.v1.Session; it is a Graph"),
    "closed": ("UsageError", "the session cannot be run"),
    "not initialised": ("NotAPolicyError", "no value for the variable 'dense/kernel' (and 1 more)"),
    "without a policy": ("SignatureError", "cannot tell which output is the action"),
    "a session and a function": ("UsageError", "session and tf_function were given"),
    "a step": ("UsageError", "step=3"),
    "no function": ("UsageError", "must be a tf.function"),
    "never traced": ("UsageError", "traced for no signatures"),
    "traced twice": ("UsageError", "traced for 2 signatures"),
    "strings": ("UnsupportedOpError", "StringLength"),
    "nested": ("SourceError", "TensorFlow cannot save it"),
    "called once": ("UsageError", "takes 2 rows only"),
    "one row": ("UsageError", "takes 1 rows only"),
    "no model": ("UsageError", "must be a Keras model; it is a Dense"),
    "a subclass": ("UsageError", "does not say its inputs"),
    "never built": ("UsageError", "does not say its inputs"),
    "in a graph": ("UsageError", "a tf.Graph is the default"),
    "eager execution is off": ("UsageError", "eager execution is off"),
}


@pytest.mark.slow
@pytest.mark.usefixtures("trained")  # for its skip
def test_what_is_refused_is_said_and_leaves_nothing(tmp_path: Path) -> None:
    ran = python("-m", "tests.live.refusals", tmp_path)
    assert ran.status == 0, ran.err[-3000:]
    said = json.loads(ran.out)
    assert set(said) == set(REFUSED)
    for name, (kind, text) in REFUSED.items():
        assert said[name] is not None, name
        assert said[name]["error"] == kind, said[name]
        assert text in said[name]["what"], said[name]
        assert said[name]["fix"], said[name]
    for name in ("never traced", "traced twice", "called once", "a subclass"):
        assert "get_concrete_function" in said[name]["fix"]
    assert files_in(tmp_path) == set()


# ------------------------------------------------------------------ without TensorFlow


def test_there_is_one_source(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no source was given\n  fix: .*source, session, tf_function, keras_model"):
        export_model(out=tmp_path)
    with pytest.raises(UsageError, match="source and keras_model were given"):
        export_model("model.bytes", tmp_path, keras_model=object())
    with pytest.raises(UsageError, match="session and tf_function and keras_model were given"):
        export_model(out=tmp_path, session=1, tf_function=2, keras_model=3)
    assert files_in(tmp_path) == set()


@pytest.mark.parametrize("kind", ["session", "tf_function", "keras_model"])
def test_tensorflow_is_not_loaded_for_an_object_that_is_not_its_own(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "tensorflow", raising=False)
    with pytest.raises(UsageError, match=f"{kind} is str, and TensorFlow is not loaded"):
        export_model(out=tmp_path, **{kind: "policy"})  # type: ignore[arg-type]
    assert "tensorflow" not in sys.modules
    assert files_in(tmp_path) == set()
