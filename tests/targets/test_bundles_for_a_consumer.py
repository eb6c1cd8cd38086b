"""Bundles made with ``--for``: acting, verifying, code and reading work under the consumer's names, or say why not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.exporter.export.pipeline import ExportResult
from export_model.signatures.errors import UsageError
from tests import commands
from tests.exporting import export_model, load_policy

pytest.importorskip("onnxruntime")
FIXTURES = Path(__file__).resolve().parents[2] / "fixtures"


def made(name: str, wanted: str, folder: Path) -> ExportResult:
    (result,) = export_model(FIXTURES / name, folder, for_=wanted, verify="none")
    return result


def test_a_hybrid_with_memory_acts_as_under_its_own_names(tmp_path: Path) -> None:
    source = FIXTURES / "torch_checkpoint" / "ppo_1_1_hybrid_lstm.onnx"
    (plain,) = export_model(source, tmp_path / "plain", to="onnx", verify="none")
    own = load_policy(plain.folder)
    dressed = load_policy(made("torch_checkpoint/ppo_1_1_hybrid_lstm.onnx", "unity6", tmp_path).folder)
    (seen,), (given,) = own.signature.observations, dressed.signature.observations
    first, second = own.agent(deterministic=True), dressed.agent(deterministic=True)
    state = np.random.default_rng(0).standard_normal((3, int(seen.shape[1] or 0)))
    for _ in range(3):
        a, b = first.decide({seen.name: state}), second.decide({given.name: state})
        assert a.continuous is not None and b.continuous is not None and a.discrete is not None
        np.testing.assert_allclose(b.continuous, a.continuous, atol=1e-6)
        np.testing.assert_array_equal(b.discrete, a.discrete)


@pytest.mark.parametrize(("name", "wanted"), [("continuous.bytes", "tfsharp-0.6"), ("sampled.bytes", "tfsharp-0.5")])
def test_an_action_that_only_the_file_draws_is_not_called_one_without_chance(
    name: str, wanted: str, tmp_path: Path
) -> None:
    policy = load_policy(made(name, wanted, tmp_path).folder)
    seen = {s.name: np.ones((1, *(int(d or 1) for d in s.shape[1:]))) for s in policy.signature.observations}
    policy.decide(seen)
    with pytest.raises(UsageError, match="cannot be had without chance"):
        policy.decide(seen, deterministic=True)


@pytest.mark.parametrize(("wanted", "runtime"), [("unity6", "onnxruntime"), ("tfsharp-0.6", "numpy")])
def test_verify_dresses_the_source_and_compares(wanted: str, runtime: str, tmp_path: Path) -> None:
    folder = made("recurrent.bytes", wanted, tmp_path).folder
    how = ("--source", FIXTURES / "recurrent.bytes", "--runtimes", runtime, "--allow-unverified")
    held = commands.export_model("verify", folder, *how)
    assert held.status == 0, held.out
    assert "the policy under its own names, from which this was made: " in held.out
    assert "no numbers of" not in held.out


def test_without_the_source_it_is_said_that_no_numbers_were_compared(tmp_path: Path) -> None:
    asked = commands.export_model("verify", made("recurrent.bytes", "barracuda-3", tmp_path).folder)
    accepted = "ACCEPTED by Unity's checks (release 20) and our model of Unity's player (release 20); no numbers of"
    assert asked.status == 0 and accepted in " ".join(asked.out.split())


def test_snippets_know_the_profile_by_its_name(tmp_path: Path) -> None:
    agent = commands.export_model("snippets", made("visual.bytes", "unity6", tmp_path / "6").folder, "--for", "unity6")
    assert "visual.onnx, made for ML-Agents 3.0 and 4.0" in agent.out
    brain = made("visual.bytes", "tfsharp-0.2", tmp_path / "2").folder
    assert "Internal" in commands.export_model("snippets", brain, "--for", "tfsharp-0.2").out
    ran = commands.export_model("snippets", brain, "--for", "barracuda")
    assert ran.status == 2 and "it was made for tfsharp-0.2" in ran.err


def test_such_a_bundle_is_a_source_like_any_other(tmp_path: Path) -> None:
    bundle = made("recurrent.bytes", "unity6", tmp_path / "6").folder
    (result,) = export_model(bundle, tmp_path / "again", for_="tfsharp-0.6", verify="none")
    assert any("a bundle made with --for unity6" in note for note in result.policy.signature.notes)
    ran = commands.export_model("serve", bundle, "-o", tmp_path / "page")
    assert ran.status == 2 and "without --for" in ran.err
