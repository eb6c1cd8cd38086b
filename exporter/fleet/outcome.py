"""What becomes of a source of many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct

from export_model.exporter.fleet.ledger import Stamp, State
from export_model.exporter.reports.entry import Entry
from export_model.signatures.errors import ExportModelError, RefusedError


class Written(Struct, frozen=True):
    """A policy of many, written.

    ``entry`` is there where reports were asked for, ``failure`` where formats disagree; ``undecided`` says why nothing
    was decided.
    """

    name: str
    folder: Path
    passed: bool | None
    what: str
    renamed: str | None = None
    failure: str | None = None
    undecided: str = ""
    answer: Mapping[str, Any] | None = None
    entry: Entry | None = None


class Outcome(Struct, frozen=True):
    """What became of a source: its policies, or why there are none (or not all of them)."""

    path: Path
    policies: tuple[Written, ...] = ()
    error: ExportModelError | None = None
    unchanged: bool = False
    #: what tells whether it is unchanged; ``files`` is None where it did not stay so while it was exported
    seen: State = None
    files: Mapping[str, Stamp] | None = None

    @property
    def failed(self) -> bool:
        """Whether it was refused or formats disagree."""
        return self.error is not None or any(p.passed is False for p in self.policies)


def one_error(refused: Sequence[ExportModelError], written: int) -> ExportModelError:
    """The error of a source of which so many policies were written, and others were not."""
    return refused[0] if len(refused) == 1 else RefusedError(refused, len(refused) + min(written, 1))
