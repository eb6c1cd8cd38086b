"""What a verification says of its findings: what was checked, what decides, what is worst, who takes part."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.files.children.process import RunFailedError
from export_model.converters.runtimes.registry import RuntimeInfo
from export_model.exporter.verify.checks.numbers import _mostly_open, largest, plausible, rank, sum_differences
from export_model.exporter.verify.difference import Difference, wrong
from export_model.exporter.verify.excuses import BOTH_NAN, CHAOS, NOT_FROM_ZERO, ROUNDING, Forgiven, add_forgiven
from export_model.exporter.verify.findings import (
    Accepted,
    Bisection,
    Decisions,
    Draws,
    Failure,
    Finding,
    Numbers,
    Played,
    Shape,
    Size,
    Stated,
    Undecided,
    failure,
    share_text,
    stated_finding,
    undecided_finding,
)
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.participants import (
    Participant,
    in_order,
    load_model,
    needed_runtimes,
    policy_under_test,
    unfit_reason,
)
from export_model.exporter.verify.report import Pair, ParityReport
from export_model.exporter.verify.tolerances import Tolerance
from export_model.exporter.verify.verdict import (
    checked_formats,
    formats_of,
    kernel_formats,
    missing_runtimes,
    unchecked_formats,
)
from export_model.exporter.verify.verification import _report, _unproven, _with_required
from export_model.signatures.roles import Role
from export_model.signatures.sampling import Case
from export_model.signatures.spec import PolicySignature, TensorSpec
from tests.handmade import continuous_policy
from tests.verify.judged import compiled


def found(
    kind: type[Finding] = Numbers,
    form: str = "onnx",
    runtime: str = "onnxruntime",
    output: str = "action",
    passed: bool = True,
    **more: Any,
) -> Finding:
    off = more.pop("off", 0.0)
    return kind(form, runtime, output, off, off, Tolerance(), passed, "typical", **more)


def report(
    *findings: Finding, sizes: dict[str, int] | None = None, passed: bool | None = True, **more: Any
) -> ParityReport:
    states = {n: {"status": "ran", "reason": None} for n in ("onnxruntime", "numpy")}
    states["tensorflow"] = {"status": "not run", "reason": "not installed; pip install it"}
    states["litert"] = {"status": "not run", "reason": "not asked for"}
    every = {"onnx": 1, "bytes": 2} if sizes is None else sizes
    return ParityReport("policy", passed, 0, 2, "numpy", states, tuple(findings), every, **more)


# ------------------------------------------------------------------ what was checked


def test_a_format_is_checked_where_an_independent_runtime_gave_numbers() -> None:
    made = report(found(), found(form="bytes", runtime="numpy"))
    assert formats_of(made) == ["onnx", "bytes"] and checked_formats(made) == ["onnx"]
    assert unchecked_formats(made) == kernel_formats(made) == ["bytes"]
    assert made.partial and made.unchecked == ("bytes",) and not replace(made, passed=None).partial
    for kind in (Accepted, Failure, Stated, Undecided, Size):
        assert checked_formats(report(found(kind))) == []
    for kind in (Shape, Draws, Decisions):
        assert checked_formats(report(found(kind))) == ["onnx"]
    for form in ("reference", "golden", "source", "weights"):
        assert formats_of(report(found(form=form), sizes={})) == []
    assert formats_of(report(found(Size, "total"), found(Stated, "card"), found(form="tfjs"), sizes={})) == ["tfjs"]
    assert formats_of(report(found(form="saved_model:other"), found(form="saved_model"), sizes={})) == ["saved_model"]
    assert formats_of(report(found(form="onnx a/b:c"), sizes={"onnx a/b:c": 1})) == ["onnx a/b:c"]


def test_what_would_check_the_rest_is_named_once() -> None:
    made = report(found(), sizes={"onnx": 1, "saved_model": 1, "litert": 1, "bytes": 1})
    assert missing_runtimes(made, ["litert"]) == ([], ["litert"])
    install, ask = missing_runtimes(made, ["saved_model", "litert"])
    assert (install, ask) == (["tensorflow"], ["litert"])
    assert missing_runtimes(made, ["nn"]) == ([], [])
    assert missing_runtimes(made, []) == ([], [])


def test_a_pair_is_what_is_worst_of_it() -> None:
    good, bad, drawn = found(share=0.5), found(output="value", passed=False, share=3.0), found(Shape, output="draw")
    pair = Pair("onnx", "onnxruntime", (good, bad, drawn, found(share=0.7), found(Failure, output="x", passed=False)))
    assert not pair.passed and pair.word == "FAIL"
    assert {n: f.share for n, f in pair.worst.items()} == {"action": 0.7, "value": 3.0, "draw": 0.0}
    assert pair.worst_text.endswith(" value; drawn: draw")
    assert Pair("onnx", "r", (good,)).word == "ok" and Pair("onnx", "r", (found(Accepted),)).word == "accepted"
    assert Pair("onnx", "r", (found(Undecided, passed=False),)).word == "not run"
    assert Pair("onnx", "r", (found(Undecided, passed=False),)).worst_text == "not decided"
    assert Pair("onnx", "r", (found(Failure, passed=False),)).worst_text == "no answer"
    assert Pair("onnx", "r", (found(Accepted), found(Played, passed=False))).worst_text == (
        "checked, not played by our model of it"
    )
    assert Pair("onnx", "r", (found(Played),)).worst_text == "played by our model of it"
    assert Pair("onnx", "r", (found(Accepted, passed=False),)).worst_text == "not checked"
    assert Pair("onnx", "r", (good, drawn)).worst_text == "0.50 action; drawn: draw"


def test_a_report_adds_up_its_findings() -> None:
    one, two = found(share=0.2), found(form="bytes", runtime="numpy", output="value", share=0.9)
    made = report(one, two, found(Failure, output="*", passed=False))
    assert [(p.format, len(p.findings)) for p in made.pairs] == [("onnx", 2), ("bytes", 1)]
    assert made.outputs == ("action", "value") and made.failures == (made.comparisons[2],)
    assert report(one, two)._worst.endswith("(value of bytes in numpy)") and report()._worst == ""
    assert (report().verdict, report(self_consistent=True).verdict) == ("passed", "self-consistent")
    assert (report(passed=None).verdict, report(passed=False, self_consistent=True).verdict) == (
        "not verified",
        "failed",
    )
    assert report(original="tensorflow").proven and not report().proven
    assert not report(original="tensorflow", passed=None).proven
    reason = undecided_finding("onnx", "onnxruntime", "*", "why")
    assert report(reason, passed=None).undecided == "why" and report(reason).undecided == ""
    assert report(passed=None).undecided == ""
    assert report().with_findings([one]).passed is True
    assert report().with_findings([replace(one, passed=False)]).passed is False
    assert report(passed=None).with_findings([reason]).passed is None
    told = made.to_dict()
    assert "whole_sizes" not in told and "played" not in told
    assert report(whole_sizes={"onnx": 9}).to_dict()["whole_sizes"] == {"onnx": 9}


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.0, "0"), (0.009, "<0.01"), (0.01, "0.01"), (0.5, "0.50"), (99.0, "99.00"), (100.0, "1.0e+02"), (math.inf, "∞")],
)
def test_a_share_is_told_in_a_cell(share: float, text: str) -> None:
    assert share_text(share) == text == found(share=share).cell()


def test_what_did_not_pass_says_what_would() -> None:
    bad = found(passed=False, off=2.0, smallest_tolerance=0.12345, bisection=Bisection("mid", "Add"))
    assert bad.disagrees and bad.explanation()[2] == "smallest tolerance that would pass: 0.124, as atol and rtol"
    assert bad.explanation()[1].startswith("first difference: mid (Add)") and "by 2 (relative 2)" in bad.sentence()
    assert len(replace(bad, passed=True).explanation()) == 2 and len(found(passed=False).explanation()) == 1
    assert "by" not in replace(bad, max_abs_diff=math.inf).sentence().split("differs")[1].split("[")[0]
    assert replace(bad, reason="shape").sentence() == "onnx in onnxruntime: action differs: shape [numbers, typical]"
    told = bad.to_dict()
    assert (told["smallest_tolerance"], told["bisection"]["tensor"], told["share"]) == (0.12345, "mid", 0.0)
    assert replace(bad, smallest_tolerance=0.0).to_dict()["smallest_tolerance"] == 0.0
    assert "smallest_tolerance" not in replace(bad, passed=True).to_dict()
    assert "share" not in found(Draws).to_dict() and "histogram" not in told
    assert found(off=math.inf, passed=False).to_dict()["max_abs_diff"] == "inf"
    assert not found(Undecided, passed=False).disagrees and not found(passed=True).disagrees


@pytest.mark.parametrize(
    ("finding", "short"),
    [
        (found(share=0.5), "0.50"),
        (found(share=3.0, passed=False), "3.00"),
        (found(passed=False, reason="shape [1] instead of [2]"), "✗ shape [1]"),
        (found(passed=False, reason="x" * 39), "✗ " + "x" * 39),
        (found(passed=False, reason="x" * 40), "✗"),
        (found(Draws, passed=False), "✗ drawn"),
        (found(Accepted, passed=False), "✗ refused"),
        (found(Accepted), "accepted"),
    ],
)
def test_a_finding_is_told_in_a_few_characters(finding: Finding, short: str) -> None:
    assert finding.short() == short


# ------------------------------------------------------------------ what decides


def _trial() -> Any:
    class Pool:
        def versions(self) -> dict[str, str]:
            return {"onnxruntime": "9"}

    class Trial:
        tested = policy_under_test(
            compiled(continuous_policy()), {}, Path("nowhere"), sizes={"onnx": 5}, reference=Path("r")
        )
        pool = Pool()

    return Trial


def reported(
    *findings: Finding, reference: str = "numpy", runtimes: Any = ("onnxruntime", "tfjs-node"), **options: Any
) -> ParityReport:
    from export_model.exporter.verify.session import Session

    known = [
        RuntimeInfo("onnxruntime", True, "8", ""),
        RuntimeInfo("tensorflow", False, None, "pip install it"),  # type: ignore[arg-type]
        RuntimeInfo("litert", True, "3", ""),
    ]
    session = Session(runtimes, known, None, VerifyOptions(**options))  # type: ignore[arg-type]
    trial = _trial()
    trial.options = session.options
    return _report(trial, reference, session, findings, ["note"])


def test_an_independent_runtime_decides() -> None:
    assert reported(found()).passed is True
    assert reported(found(runtime="numpy")).passed is None and reported().passed is None
    assert reported(found(), found(passed=False)).passed is False
    assert reported(found(form="golden")).passed is None and reported(found(form="source")).passed is None
    assert reported(found(), found(Undecided, passed=False)).passed is None
    assert reported(found(runtime="numpy", passed=False)).passed is False
    assert (
        reported(found()).original is None and reported(found(), reference="source/tensorflow").original == "tensorflow"
    )
    assert reported(found()).self_consistent and reported(found()).notes[-1] == "note"


def test_each_runtime_has_a_version_and_a_state() -> None:
    states = reported(found()).runtimes
    assert states["onnxruntime"] == {"version": "9", "status": "ran", "reason": None}
    assert states["tensorflow"] == {"version": None, "status": "not run", "reason": "not installed; pip install it"}
    assert states["litert"] == {"version": "3", "status": "not run", "reason": "not asked for"}
    assert reported(found(runtime="litert"), runtimes=("litert",)).runtimes["litert"]["status"] == "ran", "it died"
    assert reported(found(), runtimes=()).runtimes["onnxruntime"]["status"] == "not run"


def test_what_is_required_must_be_checked() -> None:
    made = report(found(), found(form="bytes", runtime="numpy"))
    assert _with_required(made, []) is made and _with_required(made, ["onnx"]) is made
    for wanted in (["bytes"], ["all"], ["tfjs"], ["bytes", "onnx"]):
        short = _with_required(made, wanted)
        assert short.passed is None and isinstance(short.comparisons[-1], Undecided)
        assert len(short.comparisons) == 3
    assert _with_required(replace(made, passed=False), ["bytes"]).passed is False


def test_what_is_not_proven_is_not_verified() -> None:
    from export_model.exporter.verify.excuses import NAN_FROM_ZERO

    forgiven = (Forgiven(NAN_FROM_ZERO, 2, math.inf), Forgiven(ROUNDING, 3, 1.0))
    (only,) = _unproven([found(forgiven=forgiven, elements=8)])
    assert isinstance(only, Undecided) and "2 of 8 elements of action" in only.reason
    assert not list(_unproven([found(forgiven=forgiven, passed=False), found(forgiven=forgiven[1:])]))


# ------------------------------------------------------------------ differences together

SPEC = TensorSpec("action", Role.SAMPLED, "int64", (None, 2))
SIGNATURE = PolicySignature(
    inputs=(TensorSpec("state", Role.VECTOR, "float32", (None, 3)),),
    outputs=(
        SPEC,
        TensorSpec("value", Role.VALUE, "float32", (None, None)),
        TensorSpec("plain", Role.DETERMINISTIC, "int64", (None, 2)),
    ),
    family="own model",
    action_space="discrete",
    branches=(3, 2),
)


@pytest.mark.parametrize(
    ("name", "got", "narrowed", "reason"),
    [
        ("action", np.array([[0, 0], [2, 1]]), False, ""),
        ("action", np.array([[0, 0], [2, 2]]), False, "a class outside"),
        ("action", np.array([[3, 0], [2, 1]]), False, "a class outside"),
        ("action", np.array([[0, 0], [-1, 1]]), False, "a class outside"),
        ("action", np.array([[0, 0]]), False, "shape [1, 2] instead of [2, 2]"),
        ("action", np.array([[0, 0], [2, 1]], np.int32), False, "dtype int32 instead of int64"),
        ("action", np.array([[0, 0], [2, 1]], np.int32), True, ""),
        ("action", np.array([[0.0, 0], [2, 1]]), True, "dtype float64"),
        ("value", np.zeros((2, 2), np.float32), False, ""),
        ("value", np.array([[0, np.nan], [0, 0]], np.float32), False, "NaN or infinity was drawn"),
        ("value", np.array([[0, -9], [7, 0]], np.float32), False, ""),
        ("plain", np.array([[0, 0], [2, 1]]), False, "it is the action without chance"),
    ],
)
def test_a_draw_is_of_its_shape_and_range(name: str, got: Any, narrowed: bool, reason: str) -> None:
    made = plausible(SIGNATURE, name, got, Case("typical", {}, 2), narrowed=narrowed)
    assert made.passed is (not reason) and made.reason.startswith(reason)


def test_a_class_without_branches_is_any() -> None:
    free = replace(SIGNATURE, branches=())
    assert plausible(free, "action", np.array([[9, 9], [9, 9]]), Case("typical", {}, 2)).passed
    one = Case("typical", {}, 1)
    wide = replace(SIGNATURE, outputs=(replace(SPEC, shape=(None, None)), *SIGNATURE.outputs[1:]))
    assert not plausible(wide, "action", np.array([[0, 0, 0]]), one).passed, "a free axis is one wide"


def test_the_worse_of_two_differences() -> None:
    near, far, failed = Difference(0.1, 0, True), Difference(9, 0, True), Difference(0.2, 0, False)
    assert max([near, far, failed], key=rank) is failed and max([near, far], key=rank) is far
    assert largest([0.1, 0.3, 0.2]) == 0.3 and largest([0.1, None]) is None and largest([0.0]) == 0.0
    forgiven = (Forgiven(ROUNDING, 2, 0.5),)
    total = sum_differences(
        failed,
        [
            replace(near, share=0.4, elements=3, forgiven=forgiven),
            replace(far, share=0.7, elements=4, forgiven=forgiven),
        ],
    )
    assert (total.max_abs, total.share, total.elements) == (0.2, 0.7, 7)
    assert total.forgiven == (Forgiven(ROUNDING, 4, 0.5),)
    assert add_forgiven([[Forgiven(ROUNDING, 1, 0.1), Forgiven(CHAOS, 5, 9.0)], [Forgiven(ROUNDING, 2, 0.3)]]) == (
        Forgiven(ROUNDING, 3, 0.3),
        Forgiven(CHAOS, 5, 9.0),
    )
    assert (
        Forgiven(ROUNDING, 1, math.inf).to_dict()["most"] == "inf" and not Forgiven(ROUNDING, 1, 2.0).to_dict()["open"]
    )


@pytest.mark.parametrize(
    ("forgiven", "count", "said"),
    [
        ([Forgiven(CHAOS, 5, 1.0)], 10, True),
        ([Forgiven(CHAOS, 4, 1.0)], 10, False),
        ([Forgiven(CHAOS, 3, 1.0), Forgiven(NOT_FROM_ZERO, 2, 1.0)], 10, True),
        ([Forgiven(ROUNDING, 9, 1.0)], 10, False),
        ([Forgiven(CHAOS, 10, 1.0)], 10, True),
        ([Forgiven(BOTH_NAN, 10, 1.0)], 10, False),  # said elsewhere
        ([Forgiven(BOTH_NAN, 9, 1.0)], 10, True),
        ([], 0, False),
    ],
)
def test_half_of_what_is_ordinary_must_be_held_to_a_number(forgiven: list[Forgiven], count: int, said: bool) -> None:
    who = Participant(format="onnx", runtime="onnxruntime", run=None, outputs=[], model=None)  # type: ignore[arg-type]
    one = Difference(0, 0, True, elements=count, forgiven=tuple(forgiven))
    made = list(_mostly_open(who, "action", [one]))
    assert bool(made) is said and all(isinstance(f, Undecided) for f in made)


# ------------------------------------------------------------------ who takes part


def test_who_takes_part_and_in_which_order(tmp_path: Path) -> None:
    paths = {"onnx": tmp_path / "a", "saved_model": tmp_path / "b"}
    tested = policy_under_test(compiled(continuous_policy()), paths, tmp_path, sizes={})
    every = ("tensorflow", "onnxruntime", "numpy", "litert")
    assert needed_runtimes(tested, every) == ["numpy", "onnxruntime", "tensorflow"]
    assert needed_runtimes(tested, ()) == ["numpy"]
    placed = [found(form="saved_model", runtime="tensorflow"), found(), found(form="golden")]
    assert [f.format for f in in_order(placed, tested)] == ["golden", "onnx", "saved_model"]
    assert [
        f.runtime for f in in_order([found(runtime="x"), found(form="saved_model", runtime="tensorflow")], tested)
    ] == [
        "x",
        "tensorflow",
    ]
    keyed = [found(form="saved_model:other", runtime="tensorflow"), found()]
    assert [f.format for f in in_order(keyed, tested)] == ["onnx", "saved_model:other"]


def test_a_model_is_unloaded_and_one_that_is_none_is_said() -> None:
    done: list[str] = []

    class Model:
        def unload(self) -> None:
            done.append("unloaded")

    models = load_model(lambda pool, answered: (Model(), None), None, lambda error, output: None)  # type: ignore[arg-type,return-value]
    done.extend("ran" for _ in models)
    assert done == ["ran", "unloaded"]

    def refuse(pool: object, answered: bool) -> Any:
        raise RunFailedError("no")

    assert not list(load_model(refuse, None, lambda error, output: done.append(output)))  # type: ignore[arg-type]
    assert done[-1] == "*"


def test_a_runtime_that_cannot_take_a_policy_says_why(tmp_path: Path) -> None:
    from export_model.exporter.verify.participants import _RUNTIMES

    tested = policy_under_test(compiled(continuous_policy()), {}, tmp_path, sizes={})
    fixed = [n for n, r in _RUNTIMES.items() if r.fixed]
    assert fixed and all("--batch" in str(unfit_reason(n, tested)) for n in fixed)
    assert unfit_reason("onnxruntime", tested) is None
    some = replace(tested, batch=2)
    assert unfit_reason(fixed[0], some) is None
    typed = next(n for n, r in _RUNTIMES.items() if r.dtypes)
    spec = replace(tested.signature.inputs[0], dtype="float64")
    odd = replace(some, signature=replace(tested.signature, inputs=(spec,)))
    assert "float64" in str(unfit_reason(typed, odd)) or "float64" in _RUNTIMES[typed].dtypes


def test_failures_are_findings() -> None:
    error = RunFailedError("it ended", why="of a signal")
    made = failure("onnx", "onnxruntime", error)
    assert (made.output, made.reason, made.passed, made.max_abs_diff) == ("*", "it ended: of a signal", False, math.inf)
    assert stated_finding("onnx", "x").output == "interface" and made.disagrees
    assert wrong("x").reason == "x" and not wrong("x").passed
