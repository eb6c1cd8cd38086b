"""A file that a profile would write and that ML-Agents' player cannot play is refused by name, not written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from onnx import TensorProto, helper

from export_model.converters.consumers.playable import playable
from export_model.converters.consumers.profiles import PROFILES, profile
from export_model.converters.consumers.unity.consumers import CONSUMERS, EARLIER, consumer
from export_model.converters.files.chunks import Pieces
from export_model.signatures.errors import ProfileError
from tests.unity.policies import Draft


def _steps(draft: Draft) -> None:
    draft.inputs["sequence_length"] = (TensorProto.FLOAT, [1])


def _flat_memory(draft: Draft) -> None:
    draft.inputs["recurrent_in"] = (TensorProto.FLOAT, ["N", 8])
    draft.constants["memory_size"] = 8.0
    draft.actions["recurrent_out"] = 8


def _no_memory_size(draft: Draft) -> None:
    draft.inputs["recurrent_in"] = (TensorProto.FLOAT, ["N", 1, 8])


def _mask_of_rank_3(draft: Draft) -> None:
    draft.inputs["action_masks"] = (TensorProto.FLOAT, ["N", 1, 3])
    draft.actions = {"discrete_actions": 1, "deterministic_discrete_actions": 1}
    draft.constants = {"version_number": 3.0, "memory_size": 0.0, "discrete_action_output_shape": 3.0}


def written(draft: Draft, name: str = "policy.onnx") -> dict[str, Pieces]:
    return {name: Pieces(draft.model().SerializeToString())}


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("unity6", _steps, "sequence_length"),
        ("unity6", _flat_memory, "the memory is always zero"),
        ("unity6", _no_memory_size, "memory_size is 0"),
        ("barracuda-3", _flat_memory, "only the first number of the memory is kept"),
        ("barracuda-3", _mask_of_rank_3, "only the first action's mask arrives"),
        ("barracuda-1.4", _mask_of_rank_3, "only the first action's mask arrives"),
        ("barracuda-1.0", lambda draft: None, "obs_0"),
    ],
)
def test_what_cannot_be_played_is_refused(name: str, change: Callable[[Draft], None], said: str) -> None:
    draft = Draft()
    change(draft)
    with pytest.raises(ProfileError) as refused:
        playable(profile(name), written(draft), "walker")
    error = refused.value
    assert f"'walker' cannot be made for {name}: ML-Agents" in error.what and "cannot play its .onnx" in error.what
    assert said in f"{error.why} {error.where}"
    assert error.fix is not None and "export for a later consumer" in error.fix


@pytest.mark.parametrize("name", ["unity6", "barracuda-3", "barracuda-1.4"])
def test_what_is_played_is_written(name: str) -> None:
    playable(profile(name), written(Draft()), "walker")


def test_a_refused_import_is_refused() -> None:
    draft = Draft()
    draft.extra.append(helper.make_node("EyeLike", ["obs_0"], ["eye"]))
    draft.extra.append(helper.make_node("Identity", ["eye"], ["left_out"]))
    with pytest.raises(ProfileError, match="cannot be made for unity6"):
        playable(profile("unity6"), written(draft), "walker")


def test_every_profile_for_ml_agents_in_unity_names_players() -> None:
    for known in PROFILES:
        assert bool(known.players) is bool(known.importers), known.name
        assert set(known.players) <= {*CONSUMERS, *EARLIER}
        for form in known.formats if known.players else ():
            assert any(form in consumer(player).formats for player in known.players), (known.name, form)


def test_files_beside_a_model_are_not_asked(tmp_path: Path) -> None:
    playable(profile("unity6"), {"policy.json": Pieces(b"{}")}, "walker")
