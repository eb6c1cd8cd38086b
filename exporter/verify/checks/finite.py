"""Outputs of which nothing was compared: the reference has not one finite number for any typical input."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from export_model.exporter.verify.findings import Finding, undecided_finding
from export_model.exporter.verify.trial import Trial


def check_defined(trial: Trial) -> Iterator[Finding]:
    """A finding for each output that is NaN or infinite throughout, or is chosen by scores that are NaN throughout."""
    typical = [
        (case, answers)
        for case, answers in zip(trial.cases, trial.expected, strict=True)
        if case.name.startswith("typical")
    ]
    for spec in trial.signature.outputs:
        made = [answers[spec.name] for _, answers in typical if spec.name in answers and answers[spec.name].size]
        if not made:
            continue
        if made[0].dtype.kind == "f":
            without = all(not np.isfinite(each).any() for each in made)
            what = f"{spec.name} has not one finite number for any typical input"
        else:
            without = bool(typical) and trial.choices.has_only_nan_scores(spec.name, typical[-1][0].feeds)
            what = f"the scores that {spec.name} is chosen by are NaN for every typical input"
        if without:
            runtime = trial.reference.runtime
            yield undecided_finding(
                "reference", runtime, spec.name, f"{what}, so nothing was compared", typical[0][0].name
            )
