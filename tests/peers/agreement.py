"""Two models of one policy in one runtime, on the canonical inputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from export_model.converters.policy.policy import Policy
from export_model.exporter.verify.difference import compare, ties
from export_model.exporter.verify.excuses import TIE
from export_model.exporter.verify.reference import random_outputs
from export_model.exporter.verify.tolerances import Tolerance, tolerance_for
from export_model.signatures.roles import Role
from export_model.signatures.sampling import FAR_CASES, draw_cases

Run = Callable[[Mapping[str, np.ndarray], Sequence[str]], Mapping[str, np.ndarray]]

#: The policies that the fixtures give.
POLICIES = (
    "continuous",
    "discrete",
    "sampled",
    "recurrent",
    "visual",
    "twobrains-StrikerBrain",
    "twobrains-Goalie-Brain-2",
)


def disagreements(policy: Policy, ours: Run, theirs: Run) -> list[str]:
    """What differs by more than the tolerance of the project; of a drawn output, its dtype and shape only."""
    signature, found = policy.signature, []
    names = [s.name for s in signature.outputs]
    drawn = random_outputs(policy.graph, names)
    scores = next((s.name for s in signature.outputs if s.role in (Role.LOG_PROBS, Role.PROBS)), None)
    for case in draw_cases(signature):
        if case.name in FAR_CASES:  # verification measures what rounding makes there, this does not
            continue
        expected, got = ours(case.feeds, names), theirs(case.feeds, names)
        for spec in signature.outputs:
            reference, candidate = expected[spec.name], got[spec.name]
            if spec.name in drawn:
                reference, candidate = np.zeros_like(reference), np.zeros_like(candidate)
            tolerance = tolerance_for(signature, spec.name, Tolerance())
            free = None
            if spec.role is Role.DETERMINISTIC and signature.branches and scores is not None:
                free = ties(expected[scores], signature.branches, tolerance)
            difference = compare(reference, candidate, tolerance, free=[] if free is None else [(TIE, free)])
            if not difference.passed:
                found.append(f"{spec.name}, {case.name}: {difference.max_abs} {difference.reason}")
    return found
