"""What tensors are for, what they are called, and which generation of ML-Agents wrote a graph."""

from __future__ import annotations

import hashlib

import pytest

from export_model.converters.policy.generations import generation, torch_generation
from export_model.signatures.digest import sha256_hex
from export_model.signatures.errors import (
    BundleError,
    ExportModelError,
    NotAPolicyError,
    ParityError,
    RuntimeUnavailableError,
    SourceError,
    UnsupportedOpError,
)
from export_model.signatures.roles import INPUT_ROLES, OUTPUT_ROLES, Role, canonical_name, parse_role


@pytest.mark.parametrize(
    ("role", "names"),
    [
        (Role.VECTOR, ["state", "state_1", "state_2"]),
        (Role.VISUAL, ["observation_0", "observation_1"]),
        (Role.ENTITIES, ["entities_0", "entities_1"]),
        (Role.NOISE, ["epsilon", "epsilon_1"]),
        (Role.MASKS, ["action_masks", "action_masks_1"]),
        (Role.MEMORY_IN, ["recurrent_in", "recurrent_in_1"]),
        (Role.PREV_ACTION, ["prev_action", "prev_action_1"]),
        (Role.PARAMETER, ["own", "own"]),
    ],
)
def test_canonical_names_are_numbered_as_the_documentation_has_them(role: Role, names: list[str]) -> None:
    assert [canonical_name(role, i, "own") for i in range(len(names))] == names


@pytest.mark.parametrize(
    ("word", "role"),
    [
        ("vector_observation", Role.VECTOR),
        ("state", Role.VECTOR),
        ("observation", Role.VISUAL),
        ("epsilon", Role.NOISE),
        ("noise", Role.NOISE),
        ("action_masks", Role.MASKS),
        ("recurrent_in", Role.MEMORY_IN),
        ("recurrent_out", Role.MEMORY_OUT),
        ("entities", Role.ENTITIES),
        ("deed", None),
        ("", None),
        ("VECTOR", None),
    ],
)
def test_a_word_of_the_command_line_is_a_role_or_none(word: str, role: Role | None) -> None:
    assert parse_role(word) is role


def test_every_role_is_said_by_its_value() -> None:
    assert all(parse_role(role.value) is role for role in Role)
    assert not set(INPUT_ROLES) & set(OUTPUT_ROLES)


VERSION = {"trainer_major_version": 0, "trainer_minor_version": 19, "trainer_patch_version": 0}


@pytest.mark.parametrize(
    ("constants", "placeholders", "ops", "label"),
    [
        ({**VERSION, "version_number": 2}, ["vector_observation"], [], "ML-Agents 0.19.0"),
        ({**VERSION, "trainer_patch_version": 1.0}, [], [], "ML-Agents 0.19.1"),
        ({"version_number": 1}, ["vector_observation"], [], "ML-Agents 0.6"),
        ({"version_number": 2}, ["vector_observation", "epsilon"], [], "ML-Agents 0.7-0.14"),
        ({"version_number": 2}, ["vector_observation"], ["RandomStandardNormal"], "ML-Agents 0.10-0.16"),
        ({"version_number": 2}, ["vector_observation", "action_masks"], ["Log"], "ML-Agents 0.7-0.16"),
        ({}, ["vector_observation", "action_masks"], [], "ML-Agents 0.5"),
        ({"memory_size": 64}, ["visual_observation_0"], [], "ML-Agents 0.3-0.5"),
        ({}, ["vector_observation"], [], "ML-Agents 0.3-0.5"),
        ({}, ["state"], [], "ML-Agents 0.1-0.2"),
        ({}, ["observation_0", "epsilon"], [], "ML-Agents 0.1-0.2"),
        ({}, ["obs"], [], "own model"),
        ({}, [], [], "own model"),
        ({"trainer_major_version": 0}, ["x"], [], "own model"),
    ],
)
def test_the_generation_is_told_from_constants_names_and_samplers(
    constants: dict[str, float], placeholders: list[str], ops: list[str], label: str
) -> None:
    assert generation(constants, placeholders, ops) == label


DETERMINISTIC = "deterministic_continuous_actions"


@pytest.mark.parametrize(
    ("version", "inputs", "outputs", "span"),
    [
        (2, ["vector_observation"], ["action"], "0.20-0.22"),
        (2, ["vector_observation"], ["action", "continuous_actions"], "0.23-0.25"),
        (2, ["vector_observation", "memories"], ["continuous_actions"], "0.23-0.24"),
        (2, ["obs_1"], ["discrete_actions"], "0.24-0.25"),
        (2, ["obs_1", "recurrent_in"], ["discrete_actions"], "0.25"),
        (2, ["obs_1"], ["discrete_actions", "recurrent_out"], "0.25"),
        (3, ["obs_0"], ["continuous_actions"], "0.26-0.27"),
        (3, ["obs_0"], ["continuous_actions", DETERMINISTIC], "0.28-1.1"),
    ],
)
def test_the_generation_of_a_torch_export_is_told_from_its_names(
    version: int, inputs: list[str], outputs: list[str], span: str
) -> None:
    assert torch_generation(version, inputs, outputs) == f"ML-Agents {span} (PyTorch)"


def test_hashes_are_sha256() -> None:
    assert sha256_hex(b"abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert all(sha256_hex(data) == hashlib.sha256(data).hexdigest() for data in (b"", b"a" * 1_000_000))


# ------------------------------------------------------------------ errors


def test_an_error_says_what_where_why_and_what_to_do() -> None:
    error = SourceError("is a folder", where="a/b", why="a file is expected", fix="give a file")
    assert str(error) == "a/b: is a folder\n  why: a file is expected\n  fix: give a file"
    assert error.args == (str(error),)
    assert str(SourceError("no such file")) == "no such file"


def test_callers_add_where_it_happened() -> None:
    error = SourceError("is wrong", where="node 'x'").at("file.bytes")
    assert str(error) == "file.bytes: node 'x': is wrong"
    assert error.args == (str(error),)
    assert str(SourceError("is wrong").at("file.bytes")) == "file.bytes: is wrong"


@pytest.mark.parametrize(
    ("kind", "status"),
    [(ExportModelError, 2), (NotAPolicyError, 2), (BundleError, 2), (ParityError, 1), (RuntimeUnavailableError, 3)],
)
def test_each_kind_of_error_has_its_status(kind: type[ExportModelError], status: int) -> None:
    error = kind("x", where="w", why="y", fix="z")
    assert error.exit_status == status
    assert error.to_dict() == {
        "error": kind.__name__,
        "what": "x",
        "where": "w",
        "why": "y",
        "fix": "z",
        "exit_status": status,
    }


def test_an_unsupported_op_lists_every_node() -> None:
    error = UnsupportedOpError("cannot convert", issues=[("a", "Foo"), ("b", "Bar")])
    assert error.to_dict()["issues"] == [{"node": "a", "op": "Foo"}, {"node": "b", "op": "Bar"}]
    assert error.exit_status == 2
