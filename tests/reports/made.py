"""Parity reports made by hand: one that passes, one that fails in every way, one that nothing verified."""

from __future__ import annotations

from msgspec.structs import replace

from export_model.exporter.reports.entry import Entry
from export_model.exporter.verify import findings
from export_model.exporter.verify.difference import BINS
from export_model.exporter.verify.findings import Bisection, Finding, Numbers
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.tolerances import Tolerance

SPREAD = (5, 0, 0, 2, 9, *([0] * (BINS - 5)))
RAN = {"version": "1.0", "status": "ran", "reason": None}


def comparison(
    where: str, runtime: str, output: str = "action", /, kind: type[Finding] = Numbers, **more: object
) -> Finding:
    """One that passes, unless ``more`` says otherwise."""
    plain = kind(where, runtime, output, 1e-9, 1e-8, Tolerance(), True, "zeros", histogram=SPREAD, share=1e-4)
    return replace(plain, **more)  # type: ignore[arg-type]


PASSING = ParityReport(
    "runner",
    True,
    3,
    2,
    "source/tensorflow",
    {
        "numpy": RAN,
        "onnxruntime": {"version": "1.31", "status": "ran", "reason": None},
        "tfjs-cpu": {
            "version": None,
            "status": "not run",
            "reason": "not installed; export-model runtimes install tfjs",
        },
    },
    (
        comparison("reference", "numpy"),
        comparison("onnx", "onnxruntime"),
        comparison("onnx", "onnxruntime", kind=findings.Rollout, drift=(0.0, 1e-9), histogram=()),
        comparison("onnx", "onnxruntime", "value_estimate", tolerance=Tolerance(1e-3, 1e-3, "a reason | with a bar")),
    ),
    {"onnx": 1234, "tfjs": 4321},
    ("a note",),
    original="tensorflow",
)
BEGINNING = Bisection("dense/BiasAdd", "BiasAdd", "main/BiasAdd:0", (0, 3), 0.25, 0.5, 0.25, 0.2, ("dense/MatMul",))
FAILING = replace(
    PASSING,
    passed=False,
    comparisons=(
        *PASSING.comparisons,
        comparison(
            "tfjs",
            "tfjs-cpu",
            max_abs_diff=0.25,
            share=2.5e4,
            max_rel_diff=0.5,
            passed=False,
            smallest_tolerance=0.2,
            bisection=BEGINNING,
        ),
        comparison("tfjs", "tfjs-cpu", kind=findings.Rollout, passed=False, drift=(float("nan"), 0.5), histogram=()),
        comparison(
            "tfjs",
            "tfjs-cpu",
            "value_estimate",
            passed=False,
            max_abs_diff=float("inf"),
            max_rel_diff=float("inf"),
            reason="shape [1] instead of [2]",
            histogram=(),
        ),
        comparison(
            "bytes",
            "tensorflow",
            "*",
            kind=findings.Failure,
            passed=False,
            worst_input=None,
            reason="it died",
            histogram=(),
        ),
    ),
)
UNVERIFIED = replace(PASSING, passed=None, reference="numpy", original=None, comparisons=PASSING.comparisons[:1])


def entry(report: ParityReport) -> Entry:
    """An entry of which only the report is known."""
    return Entry(report)
