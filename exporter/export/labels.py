"""``--labels``: names for observations and actions, from a file into the contract."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from export_model.converters.interfaces.fit import fit_interface, name_numbers
from export_model.converters.interfaces.merge import merge
from export_model.converters.policy.policy import Policy
from export_model.exporter.options_file import read_options
from export_model.signatures.errors import UsageError
from export_model.signatures.fields import FieldError
from export_model.signatures.interface import parse_interface
from export_model.signatures.labels import validate_labels
from export_model.signatures.spec import PolicySignature

_INTERFACE = "interface"
#: Tables within tables of an interface.
_DEEPEST = 4
Labels = Path | str | Mapping[str, Any]


def read_labels(given: Labels | None) -> Mapping[str, Any] | None:
    """What a file of labels holds (TOML where its name ends so, else JSON). Raises UsageError."""
    if given is None or isinstance(given, Mapping):
        return given
    path = Path(given)
    try:
        content = read_options(path, f"--labels {path}", toml=path.suffix.lower() == ".toml")
    except (ValueError, RecursionError) as error:  # a JSON, TOML or UTF-8 error is a ValueError
        raise UsageError(
            f"--labels {path}: is neither JSON nor TOML", why=str(error)[:200], fix="correct the file"
        ) from error
    if not isinstance(content, dict):
        raise UsageError(f"--labels {path}: must be a table", fix="see docs/python-guide.md for its form")
    return content


def with_labels(policy: Policy, labels: Mapping[str, Any] | None, source: str = "--labels") -> Policy:
    """The policy with ``labels`` in its contract; without any, as it is.

    Labels of several policies stand under ``policies``, by name; else they must fit every one. Raises UsageError.
    """
    if labels is not None and "policies" in labels:
        named = labels["policies"]
        if not isinstance(named, Mapping) or len(labels) > 1:
            raise UsageError(
                "labels: 'policies' must be the only key, and holds the labels by policy",
                fix="see docs/python-guide.md",
            )
        labels = named.get(policy.name)
    if labels is None:
        return policy
    labels, stated = {k: v for k, v in labels.items() if k != _INTERFACE}, labels.get(_INTERFACE)
    if stated is not None:
        policy = replace(policy, signature=_with_interface(policy.signature, stated, source))
        if not labels:
            return policy
    return replace(policy, signature=replace(policy.signature, labels=validate_labels(labels, policy.signature)))


def _with_interface(signature: PolicySignature, stated: Any, source: str) -> PolicySignature:
    """The signature with an interface that a person states, which goes before what files do. Raises UsageError."""
    try:
        given = parse_interface(_with_source(stated, source), [s.name for s in signature.inputs])
    except FieldError as error:
        raise UsageError(f"labels: {error}", fix="write it as policy.json does; see docs/interface.md") from error
    if given is None:
        return signature
    fitted, notes = fit_interface(given, signature, {s.name: s.name for s in signature.inputs})
    if notes:
        raise UsageError(f"labels: {notes[0]}", fix="give the size of each term; they are to add up")
    if fitted is not None and signature.interface is not None:
        fitted, _ = merge(fitted, signature.interface)
    return name_numbers(replace(signature, interface=fitted))


def _with_source(stated: Any, source: str, depth: int = 0) -> Any:
    """The same with ``from`` where an entry lacks it: a mapping with a name, a text or seconds."""
    if isinstance(stated, list):
        return [_with_source(entry, source, depth) for entry in stated] if depth < _DEEPEST else stated
    if not isinstance(stated, Mapping) or depth > _DEEPEST:
        return stated
    entry = {key: _with_source(value, source, depth + 1) for key, value in stated.items()}
    return {"from": source, **entry} if {"name", "text", "seconds"} & entry.keys() else entry


def check_labels(labels: Mapping[str, Any] | None, policies: Sequence[str]) -> None:
    """Raise UsageError where there are labels for a policy that is none of these."""
    named = (labels or {}).get("policies")
    for name in named if isinstance(named, Mapping) else ():
        if name not in policies:
            raise UsageError(f"labels: unknown policy {name!r}", fix=f"there are {', '.join(policies)}")
