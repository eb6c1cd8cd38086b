"""Candidates whose weights were rounded (``--quantize int8``, ``--dtype float16``).

They are held against the reference with its weights rounded alike by numbers, and against the reference itself by what
they decide, as export and verify do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from msgspec.structs import replace

from export_model.converters.compiler.passes.weights import Storage, round_weights
from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.bundle.bundle import Bundle
from export_model.converters.formats.recognise import recognise_path
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.options import storage_of
from export_model.exporter.verify.checks.decisions import decisions
from export_model.exporter.verify.participants import PolicyUnderTest, write_reference
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.session import Session
from export_model.signatures.contract import POLICY, Contract, json_of, parse
from export_model.signatures.errors import naming


def rounded_to(path: Path) -> Storage | None:
    """Return what the weights of a bundle or of a file of one were rounded to, as its contract says; else None.

    That is the policy.json near it, else the copy that the file embeds. Raises FieldError, BundleError, SourceError.
    """
    folder = next((f for f in (path, *path.absolute().parents[:2]) if (f / POLICY).is_file()), None)
    contract = _embedded_contract(path) if folder is None else Bundle.open(folder).contract
    weights = contract and contract.tool.get("weights")
    return storage_of(str(weights)) if weights else None


def _embedded_contract(path: Path) -> Contract | None:
    kind = recognise_path(Fetched(path))
    if kind.held is None:
        return None
    with naming(path):
        content = kind.held(path)
        return None if content is None else parse(json_of(content) if isinstance(content, str | bytes) else content)


def compare_rounded(
    tested: PolicyUnderTest,
    policy: Policy,
    storage: Storage,
    folder: Path,
    run: Callable[[PolicyUnderTest], ParityReport],
    session: Session,
) -> ParityReport:
    """Return the report of ``run`` on the policy with its weights rounded, with what rounding changes of its decisions.

    ``folder`` is where the rounded policy is written to.
    """
    small_policy = replace(policy, graph=round_weights(tested.graph, storage))
    reference = write_reference(small_policy, folder, f"reference-{storage}")
    small = replace(tested, graph=small_policy.graph, reference=reference, source=None)
    report = run(small)
    found = decisions(tested, small, storage, session)
    ran = tested.source.runtime if found and tested.source and tested.source.runtime in session.runtimes else None
    note = f"weights in {storage}: numbers were compared with the reference's weights rounded alike, decisions with it"
    return replace(report.with_findings(found), notes=(*report.notes, note), self_consistent=False, original=ran)


def merge_reports(reports: Iterable[ParityReport]) -> ParityReport:
    """Return one report of several on one policy: failed where one failed, not verified where one decided nothing."""
    first, *others = reports
    if not others:
        return first
    every = (first, *others)
    comparisons = tuple({id(c): c for r in every for c in r.comparisons}.values())
    passed = [r.passed for r in every]
    verdict = (
        False if False in passed else None if any(r.undecided for r in every) else True if True in passed else None
    )
    return replace(
        first,
        passed=verdict,
        comparisons=comparisons,
        sizes={key: size for r in every for key, size in r.sizes.items()},
        original=next((r.original for r in every if r.original), None),
        notes=tuple(dict.fromkeys(note for r in every for note in r.notes)),
    )
