"""What a trial is asked: inputs in place of those that are drawn, and whether a difference is forgiven."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from export_model.exporter.verify.difference import Difference
from export_model.exporter.verify.participants import Feeds, Participant
from export_model.signatures.sampling import Case


class Inputs(Struct, frozen=True):
    """What a policy is asked in place of inputs that are drawn: states that were met, and steps in a row."""

    cases: Sequence[Case]
    steps: Sequence[Feeds] = ()


class Question(Struct, frozen=True):
    """What rules that forgive are asked of: an answer, the input or step, and how far it is off as it is."""

    name: str
    expected: Feeds
    got: np.ndarray
    participant: Participant
    at: Case | int
    found: Difference
