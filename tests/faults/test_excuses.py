"""What may forgive a difference, and what must not: blunt faults in the commonest policies, each in answers that are
otherwise right, and what reports say of the differences that were forgiven."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.files.children.process import LoadedModel
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.entry import Entry
from export_model.exporter.reports.junit import junit_xml
from export_model.exporter.reports.page import page
from export_model.exporter.reports.summary import comparison_table
from export_model.exporter.verify.excuses import CHAOS, EXCUSES
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.participants import Feeds, Participant, policy_under_test
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.session import Session
from export_model.exporter.verify.tolerances import Tolerance, ToleranceRule
from export_model.exporter.verify.verification import verify
from export_model.signatures.roles import Role
from export_model.signatures.sampling import draw_cases
from tests.faults.test_blind_spots import KNOWN, Arrays, honest, verified
from tests.faults.test_undetermined import logarithms, lowest
from tests.handmade import constant, graph_bytes, node, placeholder

ROOT = Path(__file__).resolve().parents[2]
TORCH = ("poca_0_26_discrete", "ppo_0_22_discrete", "ppo_1_1_discrete", "ppo_1_1_hybrid_lstm", "sac_0_28_hybrid_lstm")
Change = Callable[[Policy, Feeds, np.ndarray], np.ndarray]


def branches_of(policy: Policy, array: np.ndarray) -> list[np.ndarray]:
    return np.split(array, np.cumsum(policy.signature.branches)[:-1], axis=1)


def masked(feeds: Feeds) -> np.ndarray:
    return np.asarray(feeds["action_masks"] == 0)


def nan_beside_masks(policy: Policy, feeds: Feeds, scores: np.ndarray) -> np.ndarray:
    return np.where(masked(feeds).any(axis=1, keepdims=True), np.nan, scores)


def off_beside_masks(policy: Policy, feeds: Feeds, scores: np.ndarray) -> np.ndarray:
    return np.where(masked(feeds).any(axis=1, keepdims=True), scores + 0.1, scores)


SCORES: Mapping[str, Change] = {
    "zero": lambda p, f, a: a * 0,
    "0.1 more": lambda p, f, a: a + 0.1,
    "a third": lambda p, f, a: a * 0.3,
    "5 less": lambda p, f, a: a - 5,
    "reversed": lambda p, f, a: a[:, ::-1],
    "NaN beside masks": nan_beside_masks,
    "NaN of a masked class": lambda p, f, a: np.where(masked(f), np.nan, a),
    "0.1 more beside masks": off_beside_masks,
    "a masked class as likely as any": lambda p, f, a: np.where(masked(f), -0.5, a),
}


def forbidden(policy: Policy, feeds: Feeds, classes: np.ndarray) -> np.ndarray:
    made = classes.copy()
    for branch, mask in enumerate(branches_of(policy, masked(feeds))):
        rows = mask.any(axis=1)
        made[rows, branch] = mask[rows].argmax(axis=1)
    return made


CLASSES: Mapping[str, Change] = {
    "the first class": lambda p, f, a: a * 0,
    "the last class": lambda p, f, a: np.zeros_like(a) + np.array(p.signature.branches) - 1,
    "a forbidden class": forbidden,
}


def judged(source: Path, tmp_path: Path, pool: RuntimePool, options: VerifyOptions | None = None) -> ParityReport:
    """The report on a policy of which every participant has another fault, called by its label."""
    (result,) = export([source], ExportOptions(tmp_path / "out", verify="none"))
    policy = result.policy
    tested = policy_under_test(policy, {}, tmp_path, sizes={}, reference=result.folder / f"{policy.name}.bytes")
    outputs = [s.name for s in policy.signature.outputs]
    classes = [s.name for s in policy.signature.outputs if s.role is Role.DETERMINISTIC and s.dtype != "float32"]
    scores = next(s.name for s in policy.signature.outputs if s.role is Role.LOG_PROBS)
    faults = {name: (scores, change) for name, change in SCORES.items()}
    faults |= {name: (classes[0], change) for name, change in CLASSES.items()}

    def participants(numpy: LoadedModel, failed: object) -> Iterator[Participant]:
        for label, (output, change) in faults.items():

            def run(inputs: Sequence[Feeds], fetch: Any, output: str = output, change: Change = change) -> list[Arrays]:
                answers = numpy.run_all(inputs, fetch)
                for feeds, answer in zip(inputs, answers, strict=True):
                    if output in answer:
                        with np.errstate(invalid="ignore"):
                            answer[output] = change(policy, feeds, answer[output]).astype(answer[output].dtype)
                return answers

            yield Participant(format="onnx", label=label, runtime="onnxruntime", run=run, outputs=outputs, model=numpy)

    session = Session(("numpy", "onnxruntime"), KNOWN, pool, options or VerifyOptions())
    return verify(tested, session, participants)


@pytest.mark.parametrize("name", TORCH)
def test_blunt_faults_of_discrete_actions_are_found(name: str, tmp_path: Path, processes: RuntimePool) -> None:
    """ML-Agents' masks, ``logits·m - (1 - m)·1e8``, opened every choice; masked classes were left open throughout."""
    report = judged(ROOT / "fixtures" / "torch_checkpoint" / f"{name}.onnx", tmp_path, processes)
    found = {f.format for f in report.failures if f.kind == "numbers"}
    assert found == {*SCORES, *CLASSES}


def test_masks_and_ids_are_ordinary_inputs() -> None:
    (result,) = export([ROOT / "fixtures" / "torch_checkpoint" / "ppo_1_1_discrete.onnx"], ExportOptions(verify="none"))
    ordinary = {case.name for case in draw_cases(result.policy.signature) if case.ordinary}
    assert {"all but one action masked", "random masks", "one or two actions masked", "typical, batch 521"} <= ordinary
    assert not ordinary & {"zeros", "1e3", "8 to 1e4", "one number far away", "denormals", "whole numbers"}


def second_best(options: VerifyOptions, tmp_path: Path, pool: RuntimePool) -> ParityReport:
    """The report on a runtime that takes the second best class where its score is less than 0.15 from the best."""

    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        if {"action_log_probs", "deterministic_action"} <= answers.keys():
            scores = answers["action_log_probs"]
            order = np.argsort(-scores, axis=1)
            best = np.take_along_axis(scores, order, axis=1)
            near = best[:, 0] - best[:, 1] < 0.15
            answers["deterministic_action"] = np.where(near, order[:, 1], order[:, 0])[:, None]
        return answers

    return verified(ROOT / "fixtures/torch_checkpoint/poca_0_26_discrete.onnx", tmp_path, pool, spoil, options=options)


def test_a_tolerance_of_numbers_frees_no_decision(tmp_path: Path, processes: RuntimePool) -> None:
    report = second_best(VerifyOptions(tolerance=Tolerance(0.1, 0.0)), tmp_path, processes)
    assert {f.output for f in report.failures} == {"deterministic_action"}
    rule = ToleranceRule(Tolerance(0.1, 0.0, "its choices are near"), output="deterministic_action")
    report = second_best(VerifyOptions(rules=(rule,)), tmp_path, processes)
    assert report.passed is True, [f.explanation() for f in report.failures]
    (found,) = (c for c in report.comparisons if c.output == "deterministic_action")
    assert [f.excuse.title for f in found.forgiven] == ["as good a choice"]


def test_an_output_that_rounding_alone_decides_is_not_verified(tmp_path: Path, processes: RuntimePool) -> None:
    """A sine of a sine of 1e9: any number from -1 to 1 is as right, which is no agreement."""
    nodes = [
        *(placeholder("vector_observation"), constant("far", 1e9)),
        node("angle", "Mul", "vector_observation", "far", T=np.float32),
        node("sine", "Sin", "angle", T=np.float32),
        node("another", "Mul", "sine", "far", T=np.float32),
        node("action", "Sin", "another", T=np.float32),
    ]
    source = tmp_path / "chaos.bytes"
    source.write_bytes(graph_bytes(nodes))

    def zeros(feeds: Feeds, answers: Arrays) -> Arrays:
        state = feeds["state"]  # a product of whole numbers is exact
        ordinary = (np.abs(state) > 1e-30) & (np.abs(state) < 4) & (state != np.rint(state))
        return {n: np.where(ordinary, 0, a).astype(a.dtype) for n, a in answers.items()}

    report = verified(source, tmp_path, processes, zeros)
    assert report.passed is None, [f.explanation() for f in report.failures]
    assert report.verdict == "not verified"
    assert CHAOS.title in report.sentence and "were left open at ordinary inputs" in report.sentence
    assert verified(source, tmp_path / "right", processes, honest).passed is True


def test_a_number_of_which_both_have_nan_is_said(tmp_path: Path, processes: RuntimePool) -> None:
    nodes = [
        *(placeholder("vector_observation"), constant("least", 2.5)),
        node("moved", "Add", "vector_observation", "least", T=np.float32),
        node("action", "Sqrt", "moved", T=np.float32),
    ]
    source = tmp_path / "root.bytes"
    source.write_bytes(graph_bytes(nodes))
    report = verified(source, tmp_path, processes, honest)
    assert report.passed is True
    assert re.search(r"; [\d,]+ of [\d,]+ elements left open: NaN on both sides$", report.sentence)


def test_a_slow_runtime_runs_the_steps_with_memory_all_the_same(
    tmp_path: Path, processes: RuntimePool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("export_model.exporter.verify.work.SECONDS", 0)

    def forgets(feeds: Feeds, answers: Arrays) -> Arrays:
        return {n: a * 0 if n == "recurrent_out" else a for n, a in answers.items()}

    report = verified("recurrent", tmp_path, processes, honest)
    assert any("left out" in note for note in report.notes)
    assert {c.kind for c in report.comparisons} >= {"numbers", "rollout"}
    assert "rollout" in {f.kind for f in verified("recurrent", tmp_path / "wrong", processes, forgets).failures}


def test_every_report_says_what_was_forgiven(tmp_path: Path, processes: RuntimePool) -> None:
    report = verified(logarithms(tmp_path), tmp_path, processes, lowest)
    (found,) = (c for c in report.comparisons if c.output == "action" and c.forgiven)
    assert report.passed is True and {f.excuse.title for f in found.forgiven} >= {"not told from zero"}
    assert all(0 < f.elements < found.elements for f in found.forgiven)
    shown = {
        "terminal": comparison_table(report),
        "JSON": json.dumps(report.to_dict(), ensure_ascii=False),
        "JUnit": junit_xml([Entry(report)]).decode(),
        "HTML": page([Entry(report)]),
    }
    for each in found.forgiven:
        for text in shown.values():
            assert each.excuse.title in text
            assert f"{each.elements:,}" in text or f"{each.elements}" in text
    told = next(c["forgiven"] for c in report.to_dict()["comparisons"] if c["output"] == "action")
    assert {(f["excuse"], f["elements"], f["of"]) for f in told} == {
        (f.excuse.title, f.elements, found.elements) for f in found.forgiven
    }


def test_the_page_on_agreement_has_a_row_for_each_rule() -> None:
    text = (ROOT / "docs" / "agreement.md").read_text(encoding="utf-8")
    rows = [re.split(r"\s*\|\s*", line.strip(" |")) for line in text.splitlines() if line.startswith("| ")]
    table = [row for row in rows if len(row) == 4][1:]
    assert table == [[e.title, e.what, "yes" if e.leaves_open else "no", e.hides] for e in EXCUSES]
