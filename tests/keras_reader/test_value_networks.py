"""Keras networks of discrete games: what they were compiled with, and what they are called, tells what they give.

The oracle is Keras' own ``predict``, in a process of its own, and numpy's argmax of it.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.formats.keras.config import loss_of
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import NotAPolicyError
from export_model.signatures.roles import Role
from tests.keras_reader.conftest import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("keras_reader")]


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if importlib.util.find_spec("tensorflow") is None:
        pytest.skip("Keras is not installed; get it with: pip install tensorflow-cpu")
    folder = tmp_path_factory.mktemp("values")
    command = [sys.executable, "-m", "tests.keras_reader.make_value_networks", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, encoding="utf-8", errors="replace")
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def compiled(path: Path, **options: object) -> Policy:
    (policy,) = read_source(path).policies(CompileOptions(**options))  # type: ignore[arg-type]
    return policy


VALUES = ("q_values", "letter", "dqn", "mse", "huber", "function")


@pytest.mark.parametrize("file", [f"{n}.{kind}" for n in VALUES for kind in ("keras", "h5")] + ["dueling.keras"])
def test_the_action_is_the_largest_value(file: str, networks: Path) -> None:
    policy = compiled(networks / file)
    assert policy.signature.output("action").role is Role.DETERMINISTIC
    assert policy.signature.output("q_values").role is Role.Q_VALUES
    assert policy.signature.algorithm is None
    with np.load(networks / f"{file.partition('.')[0]}.npz") as kept:
        observed, answered = kept["observed"], kept["answered"]
    made = run_graph(policy.graph, {"state": observed}, ["action", "deterministic_action", "q_values"])
    np.testing.assert_allclose(made["q_values"], answered, rtol=1e-5, atol=1e-5)
    assert len(np.unique(answered.argmax(1))) > 1
    for name in ("action", "deterministic_action"):
        np.testing.assert_array_equal(made[name][:, 0], answered.argmax(1))


@pytest.mark.parametrize("kind", ["keras", "h5"])
def test_what_nothing_tells_is_said_with_the_flag(kind: str, networks: Path) -> None:
    signature = compiled(networks / f"open.{kind}").signature
    assert (signature.action_space, signature.algorithm) == ("continuous", None)
    (note,) = signature.notes
    assert "--output last=q_values" in note
    signature = compiled(networks / f"open.{kind}", outputs={"last": Role.Q_VALUES}).signature
    assert (signature.action_space, signature.branches) == ("discrete", (3,))


@pytest.mark.parametrize("kind", ["keras", "h5"])
def test_the_loss_is_overruled_by_the_user_with_the_flag_of_the_note(kind: str, networks: Path) -> None:
    (note,) = compiled(networks / f"mse.{kind}").signature.notes
    assert "--output last=action" in note
    signature = compiled(networks / f"mse.{kind}", outputs={"last": Role.ACTION}).signature
    assert (signature.action_space, signature.notes) == ("continuous", ())


@pytest.mark.parametrize(("name", "role"), [("actor", "continuous"), ("named", "continuous"), ("choice", "probs")])
def test_other_policies_stay_what_they_are(name: str, role: str, networks: Path) -> None:
    signature = compiled(networks / f"{name}.h5").signature
    assert signature.output("action").role == role
    assert signature.notes == ()


@pytest.mark.parametrize("kind", [".keras", ".h5", ""])
@pytest.mark.parametrize("name", ["probs", "logits", "policy", "mu"])
def test_the_action_of_several_outputs_is_told_by_its_name(name: str, kind: str, networks: Path) -> None:
    """As a SavedModel, the outputs are the keys of a dictionary."""
    policy = compiled(networks / f"{name}{kind}")
    with np.load(networks / f"{name}.npz") as kept:
        observed, answered = kept["observed"], kept["answered"]
    made = run_graph(policy.graph, {"state": observed}, ["action"])["action"]
    np.testing.assert_allclose(made, answered, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("file", ["critic.keras", "critic.h5", "called.keras"])
def test_a_critic_is_not_a_policy(file: str, networks: Path) -> None:
    with pytest.raises(NotAPolicyError, match="is a value"):
        compiled(networks / file)


def test_the_loss_is_found_in_every_form() -> None:
    for loss in ("mse", ["mse"], {"q": "mse"}, {"class_name": "function", "config": "mse"}, {"class_name": "mse"}):
        assert loss_of({"loss": json.loads(json.dumps(loss))}) == "mse"
    for training in (None, {}, {"loss": None}, {"loss": ["mse", "mse"]}, {"loss": {"a": "mse", "b": "mae"}}, [], "mse"):
        assert loss_of(training) == ""
