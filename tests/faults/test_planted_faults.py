"""Every deliberate fault, in every format that can have it, is caught in the real runtimes and pointed at."""

from __future__ import annotations

import math

import pytest

from export_model.converters.formats.registry import WRITTEN
from export_model.exporter.export.again import verify_folder
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify.checks.draws import MISFED
from export_model.exporter.verify.findings import Finding
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.report import ParityReport
from tests.commands import export_model, is_refused
from tests.faults.artefacts import FORMATS, opened
from tests.faults.conftest import Bundle, Planted
from tests.faults.table import FAULTS, Fault

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("runtimes"), pytest.mark.usefixtures("runtimes")]

#: TensorFlow runs the source everywhere; the others run what is planted in.
RUNTIMES = {
    "bytes": ("tensorflow",),
    "saved_model": ("tensorflow",),
    "tfjs": ("tensorflow", "tfjs-cpu", "tfjs-wasm"),
    "onnx": ("tensorflow", "onnxruntime"),
}
FIXTURES = sorted({fault.fixture for fault in FAULTS})
CELLS = [
    pytest.param(
        fault,
        kind,
        id=f"{fault.name}-{kind}",
        marks=[pytest.mark.skip(reason=fault.cannot[kind])] if kind in fault.cannot else [],
    )
    for fault in FAULTS
    for kind in FORMATS
]


def verified(planted: Planted, kind: str) -> ParityReport:
    options = VerifyOptions(samples=1)
    return verify_folder(planted.folder, source=planted.source, runtimes=RUNTIMES[kind], options=options)


@pytest.mark.parametrize("name", FIXTURES)
def test_without_a_fault_all_is_well(name: str, bundle: Bundle) -> None:
    """What is written here again, unchanged, passes: what follows is found for the faults and nothing else."""
    planted = bundle(name)
    for kind in FORMATS:
        opened(kind, planted.folder).save()
    report = verify_folder(planted.folder, source=planted.source, options=VerifyOptions(samples=1))
    assert report.passed is True, "\n".join(failure_lines(report))
    assert all(c.bisection is None and c.smallest_tolerance is None for c in report.comparisons)


@pytest.mark.parametrize(("fault", "kind"), CELLS)
def test_a_fault_is_caught_and_pointed_at(fault: Fault, kind: str, bundle: Bundle) -> None:
    planted = bundle(fault.fixture)
    artefact = opened(kind, planted.folder)
    fault.plant(artefact)
    artefact.save()
    if kind in fault.refused:
        is_refused(export_model("verify", planted.folder), fault.refused[kind])
        return
    report = verified(planted, kind)
    assert report.passed is False
    assert {c.format.split(":")[0] for c in report.failures} == {kind}, "\n".join(failure_lines(report))
    kernels = () if fault.kind == "draws" else ("numpy",)  # which draw from a seed of their own
    for runtime in (*kernels, *RUNTIMES[kind]):
        if runtime in WRITTEN[kind].runtimes:
            _pointed_at(fault, kind, runtime, report)


def _pointed_at(fault: Fault, kind: str, runtime: str, report: ParityReport) -> None:
    failures = [c for c in report.failures if (c.format, c.runtime) == (kind, runtime)]
    (found,) = [c for c in failures if c.kind == fault.kind and c.output in (fault.output, "*")]
    terminal = "\n".join(failure_lines(report))
    assert f"{kind} in {runtime}: " in terminal
    if not fault.tensors:
        assert fault.words in found.reason
        assert fault.words in terminal
        assert found.bisection is None
        return
    tensors, op = fault.elsewhere.get(kind, (fault.tensors, fault.op))
    _named(found, tensors, op)
    assert found.bisection is not None
    assert f"first difference: {found.bisection.tensor} ({found.bisection.op})" in terminal
    entry = found.to_dict()
    assert entry["bisection"]["tensor"] == found.bisection.tensor
    derived = fault.output == "deterministic_action"  # of which the source has no tensor
    assert bool(entry["bisection"]["source"]) is not derived


def _named(found: Finding, tensors: tuple[str, ...], op: str) -> None:
    bisection = found.bisection
    assert bisection is not None
    assert bisection.tensor in tensors, bisection
    assert bisection.op == op or not op
    if bisection.op == "Multinomial":
        assert bisection.reason == MISFED
        return
    assert bisection.index is not None
    assert bisection.expected is not None
    assert bisection.got is not None
    assert bisection.expected != bisection.got
    if found.kind == "rollout":
        assert bisection.input is not None
        assert bisection.input.startswith("step ")
    if not bisection.reason and found.output != "deterministic_action":  # an index has no tolerance
        assert bisection.smallest_tolerance is not None
        assert bisection.smallest_tolerance > 0
    if math.isfinite(found.max_abs_diff) and found.output != "deterministic_action":
        assert found.smallest_tolerance is not None
        assert found.smallest_tolerance > found.tolerance.atol
        if tensors[0].endswith("/read"):
            assert found.smallest_tolerance > 10 * found.tolerance.atol


@pytest.mark.parametrize("kind", FORMATS)
def test_a_file_that_was_changed_is_caught_by_its_hash_first(kind: str, bundle: Bundle) -> None:
    planted = bundle("continuous")
    artefact = opened(kind, planted.folder)
    FAULTS[0].plant(artefact)
    artefact.save(hashes=False)
    is_refused(export_model("verify", planted.folder), "has been changed since it was exported")


@pytest.mark.parametrize("kind", FORMATS)
def test_the_command_line_points_at_the_fault(kind: str, bundle: Bundle) -> None:
    planted = bundle("continuous")
    artefact = opened(kind, planted.folder)
    FAULTS[0].plant(artefact)
    artefact.save()
    which = ("--runtimes", ",".join(RUNTIMES[kind]), "--samples", "1")
    ran = export_model("verify", planted.folder, "--source", planted.source, *which)
    assert (ran.status, ran.err) == (1, "")
    assert f"  {kind} in {RUNTIMES[kind][-1]}: action differs by " in ran.out
    assert "first difference: dense/kernel/read (Const)" in ran.out
    assert "smallest tolerance that would pass: " in ran.out
    ran = export_model("verify", planted.folder, "--source", planted.source, *which, "--json")
    failed = [c for c in ran.json["reports"][0]["comparisons"] if not c["passed"] and c["output"] == "action"]
    assert {c["bisection"]["tensor"] for c in failed} == {"dense/kernel/read"}
    assert {tuple(c["bisection"]["index"]) for c in failed} == {(3, 1)}
    got = failed[0]["bisection"]
    assert got["got"] - got["expected"] == pytest.approx(0.01, rel=1e-3)


def test_the_smallest_tolerance_is_one_that_passes(bundle: Bundle) -> None:
    planted = bundle("continuous")
    artefact = opened("onnx", planted.folder)
    # Of numbers: a constant that is another one is a finding at any tolerance.
    next(fault for fault in FAULTS if fault.name == "swish replaced by relu").plant(artefact)
    artefact.save()
    report = verified(planted, "onnx")
    least = max(c.smallest_tolerance or 0.0 for c in report.failures)
    which = ("--runtimes", "onnxruntime", "--samples", "1", "--source", planted.source)

    def status(tolerance: float) -> int:
        bounds = ("--atol", repr(tolerance), "--rtol", repr(tolerance))
        return export_model(
            "verify", planted.folder, "--runtimes", ",".join(RUNTIMES["onnx"]), *which[2:], *bounds
        ).status

    assert (status(least), status(least * 0.99)) == (0, 1)
