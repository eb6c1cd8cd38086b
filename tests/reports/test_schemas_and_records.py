"""policy.schema.json says what is written, and the records of a contract what is read: both say the same.

The schema may be narrower (an option that is as usual is not written), and has the words that people read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import pytest
from msgspec.json import schema_components

from signatures import contract
from signatures.interface import Interface
from signatures.spec import PolicySignature, SourceMap
from tests.reports.validation import schema

Node = Mapping[str, Any]
#: Where the record holds any JSON, which another type reads: the place in it, and that type.
READ_BY: dict[tuple[str, str], Any] = {
    ("TensorSpec", "distribution"): contract.Distribution,
    ("PolicySignature", "preprocess"): dict[str, contract.Preprocess],
}
#: What the schema leaves to the text, and the records say to the last bound.
IN_WORDS = ("distribution", "preprocess", "labels")


def read_schema() -> tuple[Node, Mapping[str, Any]]:
    """The schema of what is read, by msgspec, and its parts by name."""
    kinds = [PolicySignature, contract._Head, SourceMap, contract.Origin, Interface, *READ_BY.values()]
    found, parts = schema_components(kinds, schema_hook=lambda custom: {"type": "object"}, ref_template="{name}")
    for (record, member), node in zip(READ_BY, found[len(found) - len(READ_BY) :], strict=True):
        parts[record]["properties"][member] = node
    head = parts["_Head"]["properties"]
    whole = {"schema": {"const": 1}, **head, **parts["PolicySignature"]["properties"]}
    return {"type": "object", "properties": whole}, parts


def leaves(node: Node, parts: Mapping[str, Any]) -> Iterator[Node]:
    """What a node may be, with references followed."""
    target = parts.get(str(node.get("$ref", "")).rpartition("/")[2])
    if target is not None:
        yield from leaves(target, parts)
    elif "anyOf" in node:
        for each in node["anyOf"]:
            yield from leaves(each, parts)
    elif isinstance(node.get("type"), list):
        for kind in node["type"]:
            yield {**node, "type": kind}
    else:
        yield node


def differences(written: Node, read: Node, parts: tuple[Any, Any], place: str) -> Iterator[str]:
    """Where what is written is not what is read, in words."""
    mine, theirs = list(leaves(written, parts[0])), list(leaves(read, parts[1]))
    kinds = [{leaf["type"] for leaf in each if "type" in leaf} for each in (mine, theirs)]
    if kinds[0] - kinds[1] - ({"number", "integer"} if {"number", "integer"} & kinds[1] else set()):
        yield f"{place}: {kinds[0]} is written, {kinds[1]} is read"
    for leaf in mine:
        like = [each for each in theirs if each.get("type", leaf.get("type")) == leaf.get("type")]
        words = [word for each in theirs for word in each.get("enum", ())]
        if words and not {*leaf.get("enum", [leaf["const"]] if "const" in leaf else ())} <= {*words}:
            yield f"{place}: {leaf} is written, one of {words} is read"
        for each in like[:1]:
            if leaf.get("minimum", 0) < each.get("minimum", -(2**63)):
                yield f"{place}: less is written than {each['minimum']}, the least that is read"
            for inner in ("items", "additionalProperties"):
                if isinstance(leaf.get(inner), dict) and isinstance(each.get(inner), dict):
                    yield from differences(leaf[inner], each[inner], parts, f"{place}/{inner}")
            if leaf.get("type") == "object" and "properties" in leaf and "properties" in each:
                yield from members(leaf["properties"], each["properties"], parts, place)


def members(written: Node, read: Node, parts: tuple[Any, Any], place: str) -> Iterator[str]:
    """As ``differences``, of objects with named members."""
    if place != "policy/source":  # how the source is run is internal
        yield from (f"{place}: {name} is read and not documented" for name in sorted({*read} - {*written}))
    for name in written:
        if name not in read:
            yield f"{place}: {name} is documented and not read"
        elif name not in IN_WORDS:
            yield from differences(written[name], read[name], parts, f"{place}/{name}")


def test_what_is_documented_of_policy_json_is_what_is_read() -> None:
    written, (read, parts) = schema("policy"), read_schema()
    assert not [*differences(written, read, (written["$defs"], parts), "policy")]


@pytest.mark.parametrize(
    ("way", "change", "words"),
    [
        (("properties",), {"colour": {"type": "string"}}, "colour is documented and not read"),
        (("$defs", "memory", "properties", "size"), {"type": "string"}, "memory/size: {'string'} is written"),
        (("$defs", "term", "properties", "size"), {"minimum": 0}, "less is written than 1"),
        (("properties", "action_space"), {"enum": ["continuous", "both"]}, "one of"),
    ],
)
def test_a_difference_is_found(way: tuple[str, ...], change: Node, words: str) -> None:
    written, (read, parts) = schema("policy"), read_schema()
    place = written
    for step in way:
        place = place[step]
    place.update(change)
    assert any(words in said for said in differences(written, read, (written["$defs"], parts), "policy"))
    del written["properties"]["notes"]
    assert any("notes is read and" in d for d in differences(written, read, (written["$defs"], parts), "policy"))
