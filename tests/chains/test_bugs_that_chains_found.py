"""What chains of formats lost once, each in the smallest chain that lost it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.files import tensorflow_messages as schema
from export_model.exporter.export.sources import read_source
from export_model.signatures.roles import Role
from tests.chains.hops import FORMS, Hop, exported, told, walk
from tests.chains.starts import OWN

STARTS = {s.name: s for s in OWN}


def ends(name: str, *chain: Hop, folder: Path) -> None:
    for wanted, got in walk(STARTS[name], chain, folder):
        assert told(got.policy) == told(wanted.policy)


@pytest.mark.parametrize("form", FORMS)
def test_an_output_that_was_named_by_hand_stays_an_output(form: str, tmp_path: Path) -> None:
    """``--output NAME=other``: its name says nothing, so it was lost where the artefact was read again."""
    ends("another-output", Hop(form), Hop("bytes"), folder=tmp_path)
    ((_, got),) = walk(STARTS["another-output"], [Hop(form), Hop("bytes")], tmp_path / "again")
    assert got.policy.signature.output("contact").role is Role.OTHER


@pytest.mark.parametrize("form", FORMS)
def test_a_class_of_one_keeps_its_range(form: str, tmp_path: Path) -> None:
    """TensorFlow.js has no one-hot of depth 1, so the range of the input could not be found again."""
    ((_, got),) = walk(STARTS["class-of-one"], [Hop(form), Hop("tfjs"), Hop("bytes")], tmp_path)
    assert got.policy.signature.input("state").distribution == {"kind": "integer", "low": 0, "high": 0}


def test_notes_are_said_once(tmp_path: Path) -> None:
    """The compiler finds notes again that the contract says already; under other names they are other notes."""
    for chain in ([Hop("bytes"), Hop("tfjs"), Hop("onnx")], [Hop("bytes", names="source"), Hop("bytes")]):
        ((_, got),) = walk(STARTS["parameter"], chain, tmp_path / chain[0].names)
        (note,) = got.policy.signature.notes
        assert note.startswith("gain is an input whose meaning is not known")


def test_the_branch_list_of_torch_is_kept(tmp_path: Path) -> None:
    """``--names source`` wrote torch's constants as int32 scalars, and none for a list of branches."""
    place = STARTS["torch-branches"].make(tmp_path)
    (result,) = exported(place, tmp_path / "out", Hop("bytes", names="source"), CompileOptions())
    assert result.contract["constants"]["discrete_action_output_shape"] == [3, 2]
    (again,) = read_source(result.folder / f"{result.policy.name}.bytes").models
    for name, value in (("discrete_action_output_shape", [[3, 2]]), ("version_number", [3])):
        array = again.graph.constant(name)
        assert array is not None
        assert array.dtype == np.float32
        assert array.tolist() == value
    ends("torch-branches", Hop("tfjs"), Hop("bytes", names="source"), folder=tmp_path / "chain")


def test_a_draw_from_one_class_is_a_draw_behind_a_cast(tmp_path: Path) -> None:
    """TensorFlow.js narrows it, ONNX raises an ArgMax with a cast: two formats on, it was an action without chance."""
    ends("single-action", Hop("tfjs"), Hop("onnx"), Hop("bytes"), folder=tmp_path)


def test_names_of_a_scope_are_kept(tmp_path: Path) -> None:
    """The companions stand outside of the scope, the trainer's outputs in it, however often they are read."""
    ends("scoped", *[Hop(form, names="source") for form in ("tfjs", "onnx", "saved_model")], folder=tmp_path)
    ((wanted, _),) = walk(STARTS["scoped"], [Hop("bytes", names="source")], tmp_path / "direct")
    assert [s.name for s in wanted.policy.signature.outputs][:2] == ["GoalieBrain/action", "deterministic_action"]


@pytest.mark.parametrize(
    ("name", "algorithm"),
    [("continuous", "PPO"), ("visual", "SAC"), ("torch-sac", "SAC"), ("torch-hybrid", "PPO"), ("sampled", None)],
)
def test_the_algorithm_does_not_change_with_deterministic(name: str, algorithm: str | None, tmp_path: Path) -> None:
    """It was told by the noise and the tanh of what is exported: without chance PPO was BC, and SAC was PPO."""
    chain = [Hop("bytes"), Hop("bytes", deterministic=True), Hop("onnx")]
    ((wanted, got),) = walk(STARTS[name], chain, tmp_path)
    assert wanted.policy.signature.algorithm == algorithm
    assert got.policy.signature.algorithm == algorithm


def test_the_note_on_noise_goes_with_the_noise(tmp_path: Path) -> None:
    ((_, with_noise),) = walk(STARTS["visual"], [Hop("bytes"), Hop("tfjs")], tmp_path / "a")
    assert any("is now the input epsilon" in n for n in with_noise.policy.signature.notes)
    ((_, without),) = walk(STARTS["visual"], [Hop("bytes"), Hop("tfjs", deterministic=True)], tmp_path / "b")
    assert not any("epsilon" in n for n in without.policy.signature.notes)


def test_branches_are_known_where_the_source_has_its_own_action_without_chance(tmp_path: Path) -> None:
    """torch 0.28: ``--deterministic`` took the source's own, and lost the branches with the other action."""
    place = STARTS["torch-branches"].make(tmp_path)
    (result,) = exported(place, tmp_path / "out", Hop("bytes", deterministic=True), CompileOptions())
    assert result.policy.signature.branches == (3, 2)


def test_a_draw_of_int32_is_written_as_tensorflow_1_4_has_it(tmp_path: Path) -> None:
    """TensorFlow.js draws int32; ``output_dtype``, which says so in a .bytes, came with TensorFlow 1.7."""
    ((_, got),) = walk(STARTS["sampled"], [Hop("tfjs"), Hop("bytes")], tmp_path)
    message = schema.parse(schema.GraphDef, (got.folder / f"{got.policy.name}.bytes").read_bytes(), "graph")
    draws = [n for n in message.node if n.op == "Multinomial"]
    assert draws
    assert not any("output_dtype" in n.attr for n in draws)
