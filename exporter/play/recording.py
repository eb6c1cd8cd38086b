"""States that the reference met while it played, and what it was fed in them: what every artefact is asked again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.exporter.verify.asked import Inputs
from export_model.signatures.batches import Arrays, Run
from export_model.signatures.sampling import Case
from export_model.signatures.spec import PolicySignature

#: Episodes of which states are kept.
ROWS = 64
#: Every one of the first steps is kept, and of later ones one in so many.
FIRST_STEPS, EVERY = 128, 8
MOST_CASES = 256
#: Steps for which an artefact is fed its own memory.
MEMORY_STEPS = 64
#: Of all that is kept.
MOST_BYTES = 64 << 20


class Recorder:
    """Keeps what a policy is fed: ``recording`` is its run, ``watch`` tells which episodes still go on."""

    def __init__(self, signature: PolicySignature) -> None:
        self._signature = signature
        self._cases: list[Case] = []
        self._steps: list[dict[str, np.ndarray]] = []
        self._step, self._playing, self._bytes = -1, np.zeros(0, bool), 0

    def watch(self, step: int, playing: np.ndarray) -> None:
        """Note which episodes the next decision is for."""
        self._step, self._playing = step, playing[:ROWS]

    def recording(self, run: Run) -> Run:
        """Return ``run``, with what it is fed kept."""

        def record(feeds: Arrays, fetch: Sequence[str]) -> dict[str, np.ndarray]:
            self._keep(feeds)
            return run(feeds, fetch)

        return record

    def inputs(self) -> Inputs:
        """Return what was kept, for a verification."""
        return Inputs(tuple(self._cases), tuple(self._steps if self._signature.recurrence else ()))

    def _keep(self, feeds: Arrays) -> None:
        step, self._step = self._step, -1
        if step < 0 or len(self._cases) >= MOST_CASES or (step >= FIRST_STEPS and step % EVERY):
            return
        whole = {n: a[:ROWS].copy() if self._signature.input(n).batched else a for n, a in feeds.items()}
        self._bytes += sum(array.nbytes for array in whole.values())
        if self._bytes > MOST_BYTES and self._cases:
            return
        if step < MEMORY_STEPS:
            self._steps.append(whole)
        rows = np.flatnonzero(self._playing)
        if len(rows):
            own = {n: a[rows] if self._signature.input(n).batched else a for n, a in whole.items()}
            self._cases.append(Case(f"recorded step {step + 1}", own, len(rows)))
