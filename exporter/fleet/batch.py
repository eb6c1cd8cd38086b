"""Bundles that wait for the disk together: a wait for each would be a fifth of a fleet's time."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

from msgspec.structs import replace

from export_model.converters.files.folders import size_of
from export_model.converters.formats.bundle.bundle import put_all_in_place
from export_model.exporter.fleet.outcome import Outcome, one_error
from export_model.signatures.errors import BundleError

#: A batch is put in its place when it has so many bundles, or bytes, or is so old: what a process that is killed has
#: staged is made again.
_MOST_BUNDLES, _MOST_BYTES, _MOST_SECONDS = 16, 256 << 20, 10.0


class Batch:
    """Staged bundles, and the outcomes that are certain once they are in their places.

    ``at_once``: each source's bundles are a batch. A batch that is left is given up, with what was staged.
    """

    def __init__(self, at_once: bool = False) -> None:
        self._at_once = at_once
        self._stages = ExitStack()
        self._staged: list[tuple[Path, Path]] = []
        self._waiting: list[Outcome] = []
        self._bytes, self._since = 0, 0.0

    def hold(self, stage: ExitStack, new: Path, place: Path) -> None:
        """Keep a bundle's ``stage`` open, whose folder ``new`` will be at ``place``."""
        if not self._staged:
            self._since = time.monotonic()
        self._stages.push(stage)
        self._staged.append((new, place))
        self._bytes += size_of(new)

    def add(self, outcome: Outcome) -> list[Outcome]:
        """Take what became of a source; return the outcomes that are certain now."""
        if not outcome.policies:
            return [outcome]
        self._waiting.append(outcome)
        full = len(self._staged) >= _MOST_BUNDLES or self._bytes >= _MOST_BYTES
        due = self._at_once or full or time.monotonic() - self._since >= _MOST_SECONDS
        return self.settle() if due else []

    def settle(self) -> list[Outcome]:
        """Put all bundles in their places; return the outcomes that waited for it."""
        errors = put_all_in_place(self._staged)
        outcomes, self._waiting = self._waiting, []
        self._close()
        return [_with_errors(outcome, errors) for outcome in outcomes] if errors else outcomes

    def _close(self) -> None:
        self._staged, self._bytes = [], 0
        self._stages.close()

    def __enter__(self) -> Batch:
        return self

    def __exit__(self, *error: object) -> None:
        self._close()


def _with_errors(outcome: Outcome, errors: Mapping[Path, BundleError]) -> Outcome:
    """The outcome of a source of which bundles could not be put in their places."""
    policies = tuple(p for p in outcome.policies if p.folder not in errors)
    refused = [errors[p.folder] for p in outcome.policies if p.folder in errors]
    if not refused:
        return outcome
    own = () if outcome.error is None else (outcome.error,)
    return replace(outcome, policies=policies, error=one_error((*own, *refused), len(policies)), files=None)
