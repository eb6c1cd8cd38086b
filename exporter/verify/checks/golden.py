"""The reference beside the answers that a user recorded (exporter/verify/golden.py)."""

from __future__ import annotations

from collections.abc import Iterator

from exporter.verify.checks.numbers import rank
from exporter.verify.difference import Difference
from exporter.verify.findings import Finding, Numbers
from exporter.verify.participants import Participant
from exporter.verify.trial import Trial


def recorded(trial: Trial) -> Iterator[Finding]:
    """The reference's answers against what the user recorded; what hangs on noise that was not is left out."""
    golden, reference = trial.golden, trial.reference
    names = [s.name for s in trial.signature.outputs if s.name not in reference.drawn]
    noisy = trial.tested.graph.descendants(golden.noiseless)
    names = [n for n in names if n not in noisy]
    participant = Participant("golden", reference.runtime, reference.run, names, reference.model)
    worst: dict[str, tuple[Difference, str]] = {}
    answers = trial.expected[len(trial.cases) - len(golden.cases) :]
    for case, expected, arrays in zip(golden.cases, answers, golden.answers, strict=True):
        for name in (n for n in arrays if n in names and n in expected):
            found = trial.difference(name, expected, arrays[name], participant)
            if name not in worst or rank(found) > rank(worst[name][0]):
                worst[name] = (found, case.name)
    for name, (difference, where) in worst.items():
        yield trial.finding(Numbers, participant, name, difference, where)
