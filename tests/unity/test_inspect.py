"""``inspect --unity`` at the command line: text, JSON, exit status, the agent from options, a file or the model."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from onnx import TensorProto, helper

from export_model.converters.consumers.mlagents.memory import DRAWN_KEPT
from export_model.converters.consumers.unity.checker import check_file
from export_model.converters.consumers.unity.consumers import CONSUMERS, EARLIER
from export_model.converters.consumers.unity.settings import Brain, sensors_of
from export_model.exporter.cli.app import app
from export_model.signatures.errors import UsageError
from fixtures import path as fixture
from tests.commands import export_model, is_refused
from tests.unity.policies import Draft

BALL = fixture("continuous")
BOTH = {"stochastic": True, "deterministic": True}
BOTH_NOT = {"stochastic": False, "deterministic": False}


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["inspect", *map(str, arguments)])


def in_play(path: Path, release: str = "R22", brain: Brain | None = None) -> list[str]:
    return [played.message for played in check_file(path, CONSUMERS[release], brain).played]


def test_an_accepted_policy_has_status_0_and_nothing_to_say(tmp_path: Path) -> None:
    result = run(Draft().write(tmp_path), "--unity", "all")
    assert result.exit_code == 0
    assert result.output.count("the Inspector: nothing to say") == len(CONSUMERS)
    assert "the agent (assumed from the file): actions 2 continuous; sensors VectorSensor_size5 5" in result.output


def test_a_message_is_shown_with_its_place_and_what_mends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    result = run(Draft().write(tmp_path), "--unity", "r20", "--sensors", "7", "--actions", "continuous:2")
    assert result.exit_code == 1
    assert "was expecting [?x5] for the VectorSensor_size7 Sensor." in " ".join(result.output.split())
    assert max(map(len, result.output.splitlines()[2:])) <= 80
    assert "where: input obs_0" in result.output and "fix: the sensor gives 7" in result.output


def test_the_two_modes_are_shown_apart_where_they_differ(tmp_path: Path) -> None:
    result = run(Draft(actions={"continuous_actions": 2}).write(tmp_path), "--unity", "R22,R23")
    assert result.exit_code == 0
    assert result.output.count("accepted with Deterministic Inference off only") == 2
    assert "the Inspector, Deterministic Inference on:" in result.output


def test_json_has_the_list_and_the_exceptions(tmp_path: Path) -> None:
    path = Draft(types={"version_number": np.int64}).write(tmp_path)
    result = run(path, "--unity", "R20", "--unity", "R22", "--json")
    found: dict[str, Any] = json.loads(result.output)
    assert (found["schema"], found["accepted"], result.exit_code) == (1, False, 1)
    first, second = found["verdicts"]
    assert first["accepted"] == {"stochastic": True, "deterministic": True} and first["import"] is None
    assert second["stochastic"]["load"]["exception"] == "InvalidCastException"
    assert second["stochastic"]["check_throws"] == second["stochastic"]["load"]
    assert first["brain"]["sensors"] == [{"type": "VectorSensor", "name": "VectorSensor_size5", "shape": [5]}]


def test_behavior_parameters_come_from_a_file_too(tmp_path: Path) -> None:
    parameters = tmp_path / "brain.json"
    parameters.write_text(json.dumps({"continuous": 2, "sensors": [{"type": "Eyes", "name": "Left", "shape": [6]}]}))
    result = run(Draft().write(tmp_path), "--unity", "R22", "--brain-parameters", parameters)
    assert "for the Left Sensor" in result.output and "the agent: actions 2 continuous; sensors Left 6" in result.output


def test_a_folder_is_checked_file_by_file(tmp_path: Path) -> None:
    Draft().write(tmp_path, "one.onnx")
    Draft(constants={}).write(tmp_path, "two.onnx")
    found = json.loads(run(tmp_path, "--unity", "R22", "--json").output)
    assert [v["accepted"]["stochastic"] for v in found["verdicts"]] == [True, False]


@pytest.mark.parametrize(
    "options",
    [
        ["--unity", "R19"],
        ["--unity", "R22", "--sensors", "8"],
        ["--unity", "R22", "--sensors", "1x2x3x4", "--actions", "continuous:1"],
        ["--unity", "R22", "--sensors", "8", "--actions", "2"],
        ["--actions", "continuous:2"],
    ],
)
def test_options_that_say_nothing_are_refused(tmp_path: Path, options: list[str]) -> None:
    result = run(Draft().write(tmp_path), *options)
    assert isinstance(result.exception, UsageError)


@pytest.mark.parametrize(
    ("editor", "releases", "profiles"),
    [
        ("2019.4", ["2.0.1", "1.9.1", "1.0.8"], ["barracuda-1.4", "barracuda-1.0"]),
        ("2022.3.10f1", ["R20"], ["barracuda-3"]),
        ("6", ["R22", "R23", "R23-2.4"], ["unity6"]),
        ("Unity 6000.2", ["R22", "R23", "R23-2.4"], ["unity6"]),
    ],
)
def test_an_editor_in_place_of_a_release_is_told_its_releases(
    editor: str, releases: list[str], profiles: list[str], tmp_path: Path
) -> None:
    for command in (("inspect", BALL, "--unity", editor), (BALL, "-o", tmp_path, "--for", editor)):
        ran = export_model(*command)
        is_refused(ran, "a version of the editor")
        assert re.findall(r"--unity ([\w.-]+),", ran.err) == releases
        assert list(dict.fromkeys(re.findall(r"--for ([\w.-]+)\)", ran.err))) == profiles


def test_what_is_neither_a_release_nor_an_editor_is_told_the_releases() -> None:
    is_refused(export_model("inspect", BALL, "--unity", "R19"), *(c.title for c in (CONSUMERS | EARLIER).values()))


# ------------------------------------------------------------------ what the player does


def test_what_the_player_cannot_play_is_not_accepted_though_it_is_checked(tmp_path: Path) -> None:
    draft = Draft()
    draft.inputs["sequence_length"] = (TensorProto.FLOAT, [1])
    path = draft.write(tmp_path)
    said = run(path, "--unity", "R22")
    assert said.exit_code == 1
    assert "not accepted (checked, but not played) by R22" in said.output
    assert "the Inspector: nothing to say" in said.output and "the model of the player:" in said.output
    assert "throws: InvalidCastException: Unable to cast" in " ".join(said.output.split())
    found = json.loads(run(path, "--unity", "R22,R20", "--json").output)
    first, second = found["verdicts"]
    assert found["accepted"] is False
    assert (first["accepted"], first["checked"]) == (BOTH_NOT, BOTH) and first["plays"] == BOTH_NOT
    assert first["stochastic"]["played"][0]["outcome"] == "throws at the first decision"
    assert second["accepted"] == second["plays"] == BOTH and second["overlooked"] == []


def test_a_warning_of_the_player_alone_is_accepted(tmp_path: Path) -> None:
    draft = Draft(constants={"version_number": 3.0, "memory_size": 9.0, "continuous_action_output_shape": 2.0})
    for name in ("recurrent_in", "recurrent_out"):
        draft.inputs[name] = (TensorProto.FLOAT, ["N", 1, 8])
    model = draft.model()
    model.graph.output.append(model.graph.input.pop())
    model.graph.node.append(helper.make_node("Identity", ["recurrent_in"], ["recurrent_out"]))
    path = tmp_path / "memory.onnx"
    path.write_bytes(model.SerializeToString())
    said = run(path, "--unity", "R22")
    assert said.exit_code == 0, said.output
    assert "plays, with a warning: memory_size says 9" in said.output


@pytest.mark.parametrize("release", list(EARLIER))
def test_earlier_players_are_asked_by_name(tmp_path: Path, release: str) -> None:
    result = run(Draft().write(tmp_path), "--unity", release)
    plays = release == "2.0.1"  # the others know vector_observation alone
    assert result.exit_code == (0 if plays else 1)
    assert (f": accepted by {release}" in result.output) is plays
    assert ("Unknown tensorProxy expected as input : obs_0" in " ".join(result.output.split())) is not plays


def test_an_output_that_only_resembles_the_name_is_missed_in_play(tmp_path: Path) -> None:
    path = Draft(actions={"Brain/continuous_actions": 2}).write(tmp_path)
    verdict = check_file(path, CONSUMERS["R22"])
    assert verdict.checked["stochastic"] and not verdict.accepted["stochastic"]
    assert in_play(path)[:1] == ["a player fetches the output continuous_actions, which the file does not have"]


def test_a_memory_without_its_output_is_missed_in_play(tmp_path: Path) -> None:
    draft = Draft()
    draft.inputs["recurrent_in"] = (TensorProto.FLOAT, ["N", 1, 8])
    draft.constants["memory_size"] = 16.0
    found = in_play(draft.write(tmp_path))
    assert "a player fetches the output recurrent_out, which the file does not have" in found
    assert "memory_size says 16 and recurrent_in has 8 numbers: players go by the latter" in found


def test_widths_are_compared_with_the_agent(tmp_path: Path) -> None:
    path = Draft(actions={"continuous_actions": 3, "deterministic_continuous_actions": 2}).write(tmp_path)
    verdict = check_file(path, CONSUMERS["R20"])
    assert verdict.checked == {"stochastic": True, "deterministic": True}
    assert verdict.accepted == {"stochastic": False, "deterministic": True}
    assert in_play(path, "R20") == ["continuous_actions has 3 columns and the agent 2"]


def test_a_mask_of_another_width_and_a_fixed_batch_are_told(tmp_path: Path) -> None:
    draft = Draft(
        {"obs_0": (TensorProto.FLOAT, [4, 5]), "action_masks": (TensorProto.FLOAT, ["N", 6])},
        {"discrete_actions": 2},
        {"version_number": 3.0, "memory_size": 0.0, "discrete_action_output_shape": [3.0, 2.0]},
    )
    found = in_play(draft.write(tmp_path), brain=Brain(0, (3, 2), sensors=sensors_of([[5]])))
    assert "action_masks has 6 columns, and the agent's branches together 5 (not run)" in found
    assert "obs_0 is declared for 4 agents: with any other number deciding at once the player throws" in found
    assert "discrete_actions is given out as floats, and read as integers" in found


def test_actions_of_a_kind_that_is_not_fetched_are_told(tmp_path: Path) -> None:
    draft = Draft(
        {"obs_0": (TensorProto.FLOAT, ["N", 5])},
        {"discrete_actions": 1},
        {
            "version_number": 3.0,
            "memory_size": 0.0,
            "discrete_action_output_shape": [3.0],
            "continuous_action_output_shape": 2.0,
        },
    )
    draft.inputs["action_masks"] = (TensorProto.FLOAT, ["N", 3])
    path = draft.write(tmp_path)
    assert check_file(path, CONSUMERS["R20"]).checked["stochastic"]
    told = "no continuous_actions are fetched, and the agent has some: they stay 0 (read, not run)"
    assert told in in_play(path, "R20")


def test_a_square_camera_in_tensorflows_order_is_taken_for_a_camera(tmp_path: Path) -> None:
    draft = Draft(inputs={"obs_1": (TensorProto.FLOAT, ["N", 5]), "obs_0": (TensorProto.FLOAT, ["N", 24, 24, 3])})
    node = helper.make_node("Transpose", ["obs_0"], ["nchw"], perm=[0, 3, 1, 2])
    draft.extra.append(node)
    verdict = check_file(draft.write(tmp_path), CONSUMERS["R22"])
    assert [s.shape for s in verdict.brain.sensors] == [(3, 24, 24), (5,)]
    assert not verdict.accepted["stochastic"]


@pytest.mark.parametrize("flags", [["--logdir", "x"], ["--step", "5"], ["--trust-source"], ["--set", "a=1"]])
def test_what_it_does_not_look_at_is_refused(flags: list[str], tmp_path: Path) -> None:
    is_refused(export_model("inspect", Draft().write(tmp_path), "--unity", "R22", *flags), flags[0], "not for --unity")


@pytest.mark.parametrize("deterministic", [False, True])
def test_a_memory_that_keeps_another_action_than_is_played_is_said_in_three_places(
    tmp_path: Path, deterministic: bool
) -> None:
    """The last action is kept with the memory, and a memory is one, while a file has two actions."""
    flags = ("--deterministic",) if deterministic else ()
    made = export_model(fixture("recurrent"), "-o", tmp_path, "--for", "unity6", "--verify", "none", *flags)
    bundle = tmp_path / "recurrent"
    said = export_model("inspect", bundle, "--unity", "R22", "--json")
    code = export_model("snippets", bundle, "--for", "unity6")
    assert (made.status, said.status, code.status) == (0, 0, 0)
    modes = {mode: said.json["verdicts"][0][mode] for mode in ("stochastic", "deterministic")}
    warned = {mode: [p["message"] for p in verdict["played"]] for mode, verdict in modes.items()}
    assert all(verdict["accepted"] for verdict in modes.values())
    assert warned == {"stochastic": [], "deterministic": [] if deterministic else [DRAWN_KEPT]}
    assert (DRAWN_KEPT in made.out) is not deterministic
    assert ("Deterministic Inference" in code.out) is not deterministic
