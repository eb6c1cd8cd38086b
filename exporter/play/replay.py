"""Every recorded state, fed to an artefact: numbers and decisions step by step, held to verification's tolerances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from msgspec.structs import replace

from export_model.converters.formats.registry import narrows
from export_model.exporter.verify.checks.numbers import largest, plausible, rank
from export_model.exporter.verify.difference import Difference, add_histograms
from export_model.exporter.verify.findings import Finding, Numbers, Shape
from export_model.exporter.verify.participants import Feeds, Participant
from export_model.exporter.verify.trial import Trial
from export_model.signatures.sampling import Case

#: Steps that are compared before the first difference among them is looked for.
_TOGETHER = 16


def replay(trial: Trial, participant: Participant) -> Iterator[Finding]:
    """A finding for each output: the first step that differs, else the largest difference of all.

    An output whose first difference was found is not looked at in later steps: they follow from it, or say no more.
    """
    allowance = trial.allowances.of(participant, "recorded steps")
    pairs = [
        (case, expected)
        for number, (case, expected) in enumerate(zip(trial.cases, trial.expected, strict=True))
        if number == 0 or allowance.takes(case.batch, case.name)
    ]
    seen: dict[str, list[tuple[Difference, Case]]] = {n: [] for n in participant.outputs}
    for first in range(0, len(pairs), _TOGETHER):
        part = pairs[first : first + _TOGETHER]
        names = [n for n, found in seen.items() if all(d.passed for d, _ in found)]
        if not names:
            break
        cases = [case for case, _ in part]
        answers = participant.run([case.feeds for case in cases], names)
        for name in names:
            got = [answer[name] for answer in answers]
            if trial.is_drawn(name, participant):
                narrowed = narrows(participant.format)
                found = [
                    plausible(trial.signature, name, a, c, narrowed=narrowed) for a, c in zip(got, cases, strict=True)
                ]
            elif name in part[0][1]:
                found = trial.differences(name, [expected for _, expected in part], got, participant, cases)
            else:
                continue
            seen[name] += zip(found, cases, strict=True)
    for name, compared in seen.items():
        if compared:
            yield _finding(trial, participant, name, compared)


def _finding(trial: Trial, participant: Participant, name: str, compared: Sequence[tuple[Difference, Case]]) -> Finding:
    failed = [pair for pair in compared if not pair[0].passed]
    difference, case = failed[0] if failed else max(compared, key=lambda pair: rank(pair[0]))
    every = [d for d, _ in compared]
    difference = replace(
        difference,
        smallest_tolerance=largest([d.smallest_tolerance for d in every]),
        histogram=add_histograms(d.histogram for d in every),
        share=max(d.share for d in every),
    )
    kind: type[Finding] = Shape if trial.is_drawn(name, participant) else Numbers
    feeds: Feeds = case.feeds
    begins = trial.bisect(participant, name, difference, feeds)
    return trial.finding(kind, participant, name, difference, case.name, bisection=begins)
