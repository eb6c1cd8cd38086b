"""policy.schema.json is what the records of a contract are: the file is made of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import pytest
from msgspec.json import schema_components

from export_model.exporter.reports import policy_schema
from export_model.exporter.reports.policy_schema import FILE, schema_text
from export_model.signatures import contract
from export_model.signatures.interface import Interface
from export_model.signatures.spec import PolicySignature
from tests.reports.validation import schema


def test_the_file_is_made_of_the_records() -> None:
    again = f"make it again: python -m {policy_schema.__name__}"
    assert FILE.read_text(encoding="utf-8") == schema_text(), again


def names(node: Any) -> Iterator[str]:
    """The names of all members under a node."""
    if isinstance(node, dict):
        yield from node.get("properties", ())
        for inner in node.values():
            yield from names(inner)
    elif isinstance(node, list):
        for inner in node:
            yield from names(inner)


def test_every_field_of_a_record_is_a_member() -> None:
    """As msgspec lists them, of which nothing that is left out for readers takes one away."""
    kinds = [PolicySignature, contract.ContractHead, Interface, contract.Distribution, contract.Preprocess]
    assert {*names(schema_components(kinds))} <= {*names(schema("policy"))}


@pytest.mark.parametrize(
    ("way", "node"),
    [
        (("$defs", "Memory", "required"), ["size", "input", "output", "layout"]),
        (("$defs", "Origin", "required"), ["path", "sha256"]),
        (("$defs", "Origin", "properties", "model"), {"type": "string", "maxLength": 4000}),
        (("$defs", "CodeSection", "properties", "math"), {"const": "own"}),
        (("$defs", "Integer", "properties", "kind"), {"const": "integer"}),
        (("$defs", "Tool", "required"), ["name", "version"]),
        (("properties", "action_space"), {"type": "string", "enum": ["continuous", "discrete", "hybrid"]}),
        (
            ("properties", "algorithm"),
            {"anyOf": [{"type": "string", "minLength": 1, "maxLength": 4000}, {"type": "null"}]},
        ),
        (("properties", "interface"), {"$ref": "#/$defs/Interface"}),
    ],
)
def test_it_says_what_is_written(way: tuple[str, ...], node: Any) -> None:
    """Always or at times, null or not at all: narrower than what is read, where that takes more."""
    found = schema("policy")
    for step in way:
        found = found[step]
    if isinstance(found, Mapping):
        found = {key: value for key, value in found.items() if key != "description"}
    assert found == node
