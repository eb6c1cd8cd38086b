"""Rules: what something is, when that holds, and the sentence that says why.

A question (what is this input for?) is a table of rules that are asked in order; the first that holds decides. Its
sentence is what ``export-model inspect --why`` prints, and what stands in the error where nothing decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

from msgspec import Struct

from export_model.signatures.roles import Role

Subject = TypeVar("Subject")
Verdict = TypeVar("Verdict")


class Rule(Struct, Generic[Subject, Verdict], frozen=True):
    """``role`` is what a subject is for which ``when`` holds; ``says`` is why, as a clause."""

    role: Verdict
    when: Callable[[Subject], bool]
    says: str


class RoleDecision(Struct, frozen=True):
    """What a tensor is for (None: it is left out), why, and what spoke against it."""

    tensor: str
    role: Role | None
    says: str
    against: tuple[str, ...] = ()


def first(rules: Iterable[Rule[Subject, Verdict]], subject: Subject) -> Rule[Subject, Verdict] | None:
    """The rule that decides; None where none holds."""
    return next((rule for rule in rules if rule.when(subject)), None)


def against(rules: Iterable[Rule[Subject, Verdict]], subject: Subject, role: object) -> tuple[str, ...]:
    """What the rules say that hold for a subject too, and would have made something else of it than ``role``."""
    return tuple(dict.fromkeys(f"{r.says} ({r.role})" for r in rules if r.role != role and r.when(subject)))


def always(subject: object) -> bool:
    """True: for the last rule of a table."""
    return True
