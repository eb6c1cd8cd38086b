"""Whether a graph that computes what is stated of its action (--bake) does so: beside the policy before that."""

from __future__ import annotations

from collections.abc import Iterator

from export_model.converters.graph.run import run_graph
from export_model.exporter.verify.baked import apply_stated
from export_model.exporter.verify.checks.numbers import rank, sum_differences
from export_model.exporter.verify.findings import Finding, Numbers
from export_model.exporter.verify.trial import Trial


def check_baked(trial: Trial) -> Iterator[Finding]:
    """What the reference gives as the action, where that is not what is stated of the action before."""
    before = trial.tested.before
    if before is None:
        return
    head = next(h for h in before.signature.heads if h.is_continuous)
    names = [s.name for s in (head.spec, head.plain) if s is not None and s.name not in trial.reference.drawn]
    participant = trial.reference.participant("bake", names)
    tensors, given = [before.fetches[n] for n in names], before.feeds
    expected = []
    for case in trial.cases:
        found = run_graph(before.graph, {given[n]: a for n, a in case.feeds.items()}, tensors)
        raw = dict(zip(names, (found[t] for t in tensors), strict=True))
        expected.append(apply_stated(before.signature, raw))
    for name in names:
        got = [answers[name] for answers in trial.expected[: len(trial.cases)]]
        found_of = trial.differences(name, expected, got, participant, trial.cases)
        difference, case = max(zip(found_of, trial.cases, strict=True), key=lambda pair: rank(pair[0]))
        difference = sum_differences(difference, found_of)
        if not difference.passed or difference.forgiven:
            yield trial.finding(Numbers, participant, name, difference, case.name)
