"""What a report is written from: a policy's parity report, and of the policy itself what can be shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from msgspec import Struct

from export_model.converters.files.fetch import path_text
from export_model.converters.formats.bundle.bundle import Bundle
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.nodes import Graph
from export_model.exporter.export.pipeline import ExportResult
from export_model.exporter.markup import Markup
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.verdict import NOT_ASKED
from export_model.signatures.contract import Contract
from export_model.signatures.errors import ExportModelError
from export_model.signatures.sampling import draw_cases, draw_rollout
from export_model.signatures.spec import PolicySignature


class Entry(Struct, frozen=True):
    """One policy in a report. ``signature`` and ``graph`` are None where there is no bundle to read them from."""

    report: ParityReport
    signature: PolicySignature | None = None
    graph: Graph | None = None
    contract: Contract | None = None
    #: Steps of a rollout, to draw its inputs again.
    steps: int = 4
    #: The words of the command that makes the same comparison, where the first was run; empty: nobody can.
    command: tuple[str, ...] = ()
    #: Further sections of the page.
    more: tuple[Markup, ...] = ()

    @property
    def name(self) -> str:
        """The policy's name."""
        return self.report.policy

    @property
    def missing(self) -> dict[str, str]:
        """Runtime → why it did not run: not those that nobody asked for, or that run other formats."""
        report = self.report
        others = {r for key, f in WRITTEN.items() if key not in report.sizes for r in f.runtimes}
        others -= {r for key, f in WRITTEN.items() if key in report.sizes for r in f.runtimes}
        states = ((n, s["reason"] or "no reason given") for n, s in report.runtimes.items() if s["status"] != "ran")
        return {n: reason for n, reason in states if reason != NOT_ASKED and not (report.sizes and n in others)}

    def feeds(self, case: str) -> Mapping[str, np.ndarray]:
        """The inputs of a case by its name in the report, drawn again from the seed; empty where they are unknown."""
        if self.signature is None:
            return {}
        if case.startswith("step "):
            rollout = draw_rollout(self.signature, seed=self.report.seed, steps=self.steps)
            number = int(case.split()[1])
            memory = self.signature.memory
            fed_back = memory.input if memory is not None and number > 1 else None
            return {k: v for k, v in rollout[number - 1].items() if k != fed_back} if number <= len(rollout) else {}
        cases = draw_cases(self.signature, seed=self.report.seed, samples=self.report.samples)
        return next((c.feeds for c in cases if c.name == case), {})


def of_result(result: ExportResult, steps: int, words: Sequence[str] = ()) -> Entry | None:
    """The entry of an export; None where nothing was verified. ``words``: options to verify its bundle with."""
    if result.report is None:
        return None
    policy = result.policy
    return Entry(
        result.report,
        policy.signature,
        policy.graph,
        result.agreed,
        steps,
        ("verify", path_text(result.folder), *words),
    )


def of_bundle(report: ParityReport, folder: Path, place: Path | None, steps: int, words: Sequence[str] = ()) -> Entry:
    """The entry of a bundle that was verified again (so its files are what policy.json says).

    ``place``: the address that it was fetched from; ``words``: options to verify it again with.
    """
    found = Bundle.open(folder)
    try:
        graph = found.graph()
    except (OSError, ExportModelError):  # a report without a picture is better than none where it has gone since
        graph = None
    return Entry(report, found.signature, graph, found.contract, steps, ("verify", path_text(place or folder), *words))
