"""Names that people give to the numbers of a policy: what each observation is, what each action does.

As in policy.json: ``{"observations": {NAME: [text per number]}, "branches": [[text per action] per branch],
"actions": [text per continuous action]}``; each part may be left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

from msgspec import Meta

from export_model.signatures.errors import UsageError
from export_model.signatures.roles import Role

if TYPE_CHECKING:
    from export_model.signatures.spec import PolicySignature

#: What one text may hold: it is shown on a line, in a page and in comments of code.
MAX_LENGTH = 120
PARTS = ("observations", "actions", "branches")
_Texts = Annotated[list[Annotated[str, Meta(min_length=1, max_length=MAX_LENGTH)]], Meta(min_length=1)]


class Labels(TypedDict, total=False):
    """Names that people gave to observations and actions.

    - ``observations``: vector observation to one text per number.
    - ``actions``: one text per continuous action.
    - ``branches``: one text per action, by branch.
    """

    observations: dict[str, _Texts]
    actions: _Texts
    branches: list[_Texts]


def parse_labels(content: Any) -> dict[str, Any]:
    """Labels in their form, parts without a text left out. Raises ValueError that says what is wrong."""
    if content is None:
        return {}
    if not isinstance(content, Mapping):
        raise ValueError("labels must be a table")
    for key in content:
        if key not in PARTS:
            raise ValueError(f"{key!r} is none of {', '.join(PARTS)}")
    named = content.get("observations", {})
    if not isinstance(named, Mapping):
        raise ValueError("'observations' must be a table of lists, one per observation")
    for name in named:
        if not str(name).isprintable():
            raise ValueError(f"{name!r} is not the name of an observation")
    branches = content.get("branches", [])
    if not isinstance(branches, Sequence) or isinstance(branches, str):
        raise ValueError("'branches' must be a list of lists, one per branch")
    found: dict[str, Any] = {
        "observations": {str(name): _texts(texts, f"observation {name!r}") for name, texts in named.items()},
        "actions": _texts(content.get("actions", []), "'actions'"),
        "branches": [_texts(texts, f"branch {i}") for i, texts in enumerate(branches)],
    }
    return {key: found[key] for key in PARTS if found[key]}


def _texts(texts: Any, where: str) -> list[str]:
    if not isinstance(texts, Sequence) or isinstance(texts, str):
        raise ValueError(f"{where} has no list of texts")
    for text in texts:
        if not isinstance(text, str) or not text.strip() or not text.isprintable() or len(text) > MAX_LENGTH:
            raise ValueError(f"{where}: {text!r} must be text of 1 to {MAX_LENGTH} printable characters on one line")
    return list(texts)


def validate_labels(content: Any, signature: PolicySignature) -> dict[str, Any]:
    """Labels that fit ``signature``. Raises UsageError that names the first which does not."""
    try:
        labels = parse_labels(content)
    except ValueError as error:
        raise UsageError(
            f"labels: {error}",
            fix='write {"observations": {NAME: [texts]}, "actions": [texts], "branches": [[texts], …]}',
        ) from error
    wanted = sizes(signature)
    for name, texts in labels.get("observations", {}).items():
        if name not in wanted["observations"]:
            known = ", ".join(wanted["observations"]) or "none whose numbers can be named"
            raise UsageError(f"labels: unknown vector observation {name!r}", fix=f"the policy has {known}")
        _check_count(texts, wanted["observations"][name], f"observation {name!r}", "numbers")
    if "actions" in labels:
        if not wanted["actions"]:
            raise UsageError("labels: the policy has no continuous actions", fix="leave 'actions' out")
        _check_count(labels["actions"], wanted["actions"], "'actions'", "continuous actions")
    if "branches" in labels:
        if not wanted["branches"]:
            raise UsageError("labels: the policy has no branches of discrete actions", fix="leave 'branches' out")
        _check_count(labels["branches"], len(wanted["branches"]), "'branches'", "branches")
        for i, (texts, size) in enumerate(zip(labels["branches"], wanted["branches"], strict=True)):
            _check_count(texts, size, f"branch {i}", "actions")
    return labels


def remaining(labels: Mapping[str, Any], signature: PolicySignature) -> dict[str, Any]:
    """The labels of what ``signature`` still has: an export with other options may have left something out."""
    wanted = sizes(signature)
    named, actions, branches = (labels.get(key, {}) for key in PARTS)
    kept: dict[str, Any] = {
        "observations": {n: t for n, t in named.items() if wanted["observations"].get(n) == len(t)},
        "actions": actions if len(actions) == wanted["actions"] else [],
        "branches": branches if [len(texts) for texts in branches] == wanted["branches"] else [],
    }
    return {key: kept[key] for key in PARTS if kept[key]}


def sizes(signature: PolicySignature) -> dict[str, Any]:
    """How many texts each part has: per vector observation, of the continuous actions, per branch."""
    vectors = (s for s in signature.observations if s.role is not Role.VISUAL and s.shape)
    continuous = next((h.spec for h in signature.heads if h.is_continuous), None)
    return {
        "observations": {s.name: s.shape[-1] for s in vectors if s.shape[-1] is not None},
        "actions": 0 if continuous is None else continuous.shape[-1] or 0,
        "branches": list(signature.branches),
    }


def _check_count(texts: Sequence[object], size: int, where: str, of: str) -> None:
    if len(texts) != size:
        raise UsageError(
            f"labels: {where} has {len(texts)} texts, the policy has {size} {of}", fix="give one text for each"
        )
