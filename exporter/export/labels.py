"""``--labels``: names for observations and actions, from a file into the contract."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from converters.policy.policy import Policy
from exporter.options_file import read_options
from signatures.errors import UsageError
from signatures.labels import validate_labels

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
        raise UsageError(f"--labels {path}: must be a table", fix="see docs/acting.md for its form")
    return content


def with_labels(policy: Policy, labels: Mapping[str, Any] | None) -> Policy:
    """The policy with ``labels`` in its contract; without any, as it is.

    Labels of several policies stand under ``policies``, by name; else they must fit every one. Raises UsageError.
    """
    if labels is not None and "policies" in labels:
        named = labels["policies"]
        if not isinstance(named, Mapping) or len(labels) > 1:
            raise UsageError("labels: 'policies' stands alone and holds the labels by policy", fix="see docs/acting.md")
        labels = named.get(policy.name)
    if labels is None:
        return policy
    return replace(policy, signature=replace(policy.signature, labels=validate_labels(labels, policy.signature)))


def check_labels(labels: Mapping[str, Any] | None, policies: Sequence[str]) -> None:
    """Raise UsageError where there are labels for a policy that is none of these."""
    named = (labels or {}).get("policies")
    for name in named if isinstance(named, Mapping) else ():
        if name not in policies:
            raise UsageError(f"labels: unknown policy {name!r}", fix=f"there are {', '.join(policies)}")
