"""JSON files against their schemas, closed: a field that the schema does not document is a fault here."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

from jsonschema import Draft202012Validator

from tests.commands import ROOT


def schema(name: str) -> Any:
    """The schema of parity.json, policy.json, or what play or verify --log prints."""
    return json.loads((ROOT / "exporter" / "reports" / f"{name}.schema.json").read_text(encoding="utf-8"))


def closed(part: Any) -> Any:
    """A schema in which objects have the documented properties only, unless it says otherwise."""
    if isinstance(part, list):
        return [closed(item) for item in part]
    if not isinstance(part, dict):
        return part
    made = {key: closed(value) for key, value in part.items()}
    if "properties" in part and isinstance(part.get("type"), str):
        made.setdefault("additionalProperties", False)
    return made


@cache
def _validator(name: Any) -> Draft202012Validator:
    return Draft202012Validator(closed(schema(name)))


def _checked(name: str, data: bytes | str) -> None:
    def refuse(text: str) -> None:
        raise AssertionError(f"{text} is not JSON")

    faults = list(_validator(name).iter_errors(json.loads(data, parse_constant=refuse)))
    assert not faults, [f"{fault.json_path}: {fault.message}" for fault in faults[:5]]


def check_parity(data: bytes | str) -> None:
    """Assert that ``data`` is a parity.json as documented."""
    _checked("parity", data)


def check_policy(data: bytes | str) -> None:
    """Assert that ``data`` is a policy.json as documented."""
    _checked("policy", data)


def check_play(data: bytes | str) -> None:
    """Assert that ``data`` is what ``play --json`` prints, as documented."""
    _checked("play", data)
    check_parity(json.dumps(json.loads(data)["replay"]))
