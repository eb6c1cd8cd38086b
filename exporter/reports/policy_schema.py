"""policy.schema.json, of a contract's records: ``python -m export_model.exporter.reports.policy_schema``.

msgspec says what may stand in a field, the record's docstring what it is, in a list (``- ``name``: text``) by the names
that JSON has.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from export_model.signatures.contract import SCHEMA, CodeSection, ContractHead, Distribution, Origin, Preprocess, Tool
from export_model.signatures.fields import Text
from export_model.signatures.labels import Labels
from export_model.signatures.spec import PolicySignature

FILE = Path(__file__).with_name("policy.schema.json")
#: What stands in members that the signature has as any JSON, and that are read apart.
_READ_APART = {
    ("PolicySignature", "preprocess"): dict[Text, Preprocess],
    ("PolicySignature", "labels"): Labels,
    ("TensorSpec", "distribution"): Distribution,
}
#: Those of which all may be missing that msgspec does not require.
_OPTIONS = {kind.__name__ for kind in (CodeSection, Labels, Tool)}
#: Of a docstring's list.
_ITEM = re.compile(r"^- (``\w+``(?:, ``\w+``)*): (.+?)(?=^- |\Z)", re.DOTALL | re.MULTILINE)
#: What is for messages, or says no more than the type.
_LEFT_OUT = ("title", "default", "discriminator")
_LARGEST = 2**63 - 1


def policy_schema() -> dict[str, Any]:
    """The JSON schema of policy.json.

    What is always written is required; what a record leaves out where it is None is never null.
    """
    from msgspec.json import schema_components

    kinds = [PolicySignature, ContractHead, *_READ_APART.values()]
    found, parts = schema_components(kinds, ref_template="#/$defs/{name}")
    for (record, member), node in zip(_READ_APART, found[2:], strict=True):
        members = parts[record]["properties"]
        members[member] = {**node, **{k: v for k, v in members[member].items() if k == "default"}}
    parts = {name: _describe(name, part) for name, part in parts.items()}
    parts[Origin.__name__]["additionalProperties"] = True
    head, signature = (parts.pop(kind.__name__) for kind in (ContractHead, PolicySignature))
    own = head["properties"]
    own["files"]["minProperties"] = signature["properties"]["outputs"]["minItems"] = 1  # what else is read is refused
    members = {
        "schema": {"const": SCHEMA, "description": "Version of this schema."},
        "name": own.pop("name"),
        **signature["properties"],
        **own,
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "policy.json",
        "description": signature["description"],
        "type": "object",
        "required": [key for key in members if key not in signature["properties"] or key in signature["required"]],
        "properties": members,
        "$defs": dict(sorted(parts.items())),
    }


def schema_text() -> str:
    """The content of policy.schema.json."""
    return json.dumps(policy_schema(), indent=2, ensure_ascii=False) + "\n"


def _describe(name: str, part: dict[str, Any]) -> dict[str, Any]:
    """A part as it is kept: its members with what its docstring says of them."""
    text = re.sub(r"\n +", "\n", part.pop("description"))
    members = part.get("properties", {})
    if members and name not in _OPTIONS:
        part["required"] = [key for key, node in members.items() if "default" not in node]
    if "kind" not in members:  # a distribution is written as it is
        for node in members.values():
            if node.get("default", "") is None:
                node["anyOf"] = [each for each in node["anyOf"] if each != {"type": "null"}]
    for names, said in _ITEM.findall(text):
        for key in re.findall(r"\w+", names):
            members[key] = {"description": _sentence(said), **members[key]}
    described: dict[str, Any] = _plain({"description": _sentence(text.partition("\n\n")[0]), **part})
    return described


def _sentence(text: str) -> str:
    """Text of a docstring as a description: on one line, without marks, in JSON's words."""
    line = " ".join(text.split()).replace("``", "").replace("None", "null")
    return line[:1].upper() + line[1:]


def _plain(node: Any) -> Any:
    """A node without what says no more than its type; a choice of one is that one."""
    if isinstance(node, list):
        return [_plain(each) for each in node]
    if not isinstance(node, dict):
        return node
    made = {
        key: {name: _plain(each) for name, each in value.items()} if key == "properties" else _plain(value)
        for key, value in node.items()
        if key not in _LEFT_OUT and not (key in ("minimum", "maximum") and abs(value) >= _LARGEST)
    }
    if {"type": "number"} in made.get("anyOf", ()):
        made["anyOf"] = [each for each in made["anyOf"] if each != {"type": "integer"}]
    if len(made.get("anyOf", ())) == 1:
        made.update(made.pop("anyOf")[0])
    words = made.get("enum", ())
    if words:
        made.pop("pattern", None)
    if len(words) == 1:
        made = {"const": words[0], **{k: v for k, v in made.items() if k not in ("enum", "type")}}
    return made


def main() -> None:
    """Write the file."""
    FILE.write_text(schema_text(), encoding="utf-8")


if __name__ == "__main__":
    main()
