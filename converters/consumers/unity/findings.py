"""What a check comes to: messages of Unity's lists, exceptions that Unity throws, and what Unity does not say."""

from __future__ import annotations

from enum import StrEnum

from export_model.signatures.fields import Record


class Severity(StrEnum):
    """The type of a message in the list of ML-Agents' Inspector, by Unity's own names."""

    ERROR = "error"
    WARNING = "warning"
    INFO = "info"


class Complaint(Record, frozen=True):
    """One thing that is wrong: ``message`` in Unity's words where Unity says it, ``where`` it lies, how to mend it."""

    severity: Severity
    message: str
    where: str
    fix: str


def warning(message: str, where: str, fix: str) -> Complaint:
    """What does not end anything."""
    return Complaint(Severity.WARNING, message, where, fix)


class Thrown(Record, frozen=True, omit_defaults=False, rename={"worded": "worded_by_unity"}):
    """An exception of Unity's: its C# class, its message, what in the file it comes from, how to mend it.

    ``worded`` is false where Unity's own words are not known; ``message`` then says what happens.
    """

    exception: str
    message: str
    where: str
    fix: str
    worded: bool = True


class UnityThrows(Exception):  # noqa: N818 (it is no error of this project)
    """Carries a ``Thrown`` out of the rule that meets it; caught inside of this package."""

    def __init__(self, thrown: Thrown) -> None:
        self.thrown = thrown
        super().__init__(thrown.message)


#: The text of a NullReferenceException, which says nothing of what is null.
NULL_REFERENCE = "Object reference not set to an instance of an object."


def null_reference(where: str, fix: str) -> Thrown:
    """The exception of a value that is looked for and is not there."""
    return Thrown("NullReferenceException", NULL_REFERENCE, where, fix)
