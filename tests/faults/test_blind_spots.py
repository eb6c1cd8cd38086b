"""Large faults of kinds that verification was once blind to, each planted into a runtime that is otherwise right."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.children.process import LoadedModel
from export_model.converters.formats.frozen_graph.tensors import from_array, to_array
from export_model.converters.formats.intermediate_tensors import Sampler
from export_model.converters.formats.registry import DEFAULTS
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import RuntimeInfo
from export_model.exporter.export.again import verify_folder
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.verify import work
from export_model.exporter.verify.checks.densities import _joint
from export_model.exporter.verify.checks.generators import seen_by, with_zeros, wrong_draws
from export_model.exporter.verify.difference import Difference
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.participants import Feeds, Participant, policy_under_test
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.session import Session
from export_model.exporter.verify.statistics import ranks
from export_model.exporter.verify.tolerances import Tolerance
from export_model.exporter.verify.verification import verify
from fixtures import path as fixture
from tests.faults.artefacts import FORMATS, opened
from tests.handmade import constant, graph_bytes, node, placeholder

Arrays = dict[str, npt.NDArray[Any]]
#: What it was fed and what it answers → what it says instead.
Spoil = Callable[[Feeds, Arrays], Arrays]

KNOWN = tuple(RuntimeInfo(name, True, "1.0", "") for name in ("numpy", "onnxruntime"))


def verified(
    source: str | Path,
    tmp_path: Path,
    pool: RuntimePool,
    spoil: Spoil,
    feeding: Callable[[Feeds], Feeds] = lambda feeds: feeds,
    options: VerifyOptions | None = None,
    running: Callable[[LoadedModel, Feeds, Any], Arrays] = LoadedModel.run,
) -> ParityReport:
    """The report on a policy in the numpy kernels, and in a runtime of which ``spoil`` is what is wrong with it."""
    source = fixture(source) if isinstance(source, str) else source
    (result,) = export([source], ExportOptions(tmp_path / "out", verify="none"))
    policy = result.policy
    file = result.folder / f"{policy.name}.bytes"
    tested = policy_under_test(policy, {}, tmp_path, sizes={}, reference=file)

    def participants(numpy: LoadedModel, failed: object) -> Iterator[Participant]:
        def run(inputs: Sequence[Feeds], fetch: Any) -> list[Arrays]:
            return [spoil(feeds, dict(running(numpy, feeding(feeds), fetch))) for feeds in inputs]

        outputs = [s.name for s in policy.signature.outputs]
        yield Participant(format="onnx", runtime="onnxruntime", run=run, outputs=outputs, model=numpy)

    return verify(tested, Session(("numpy", "onnxruntime"), KNOWN, pool, options or VerifyOptions()), participants)


def honest(feeds: Feeds, answers: Arrays) -> Arrays:
    return answers


def where(rows: Callable[[npt.NDArray[Any]], npt.NDArray[Any]]) -> Spoil:
    """The action is off at the rows of the observation that a condition holds for."""

    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        if "action" in answers:
            answers["action"] = answers["action"] + 0.1 * rows(feeds["state"])[:, None].astype(np.float32)
        return answers

    return spoil


@pytest.mark.parametrize("name", ["continuous", "sampled", "recurrent"])
def test_without_a_fault_all_is_well(name: str, tmp_path: Path, processes: RuntimePool) -> None:
    report = verified(name, tmp_path, processes, honest)
    assert report.passed is True, [f.explanation() for f in report.failures]


@pytest.mark.parametrize("name", ["recurrent", "sampled"])
def test_what_rounding_makes_of_every_step_is_no_fault(name: str, tmp_path: Path, processes: RuntimePool) -> None:
    """A runtime that rounds all it computes otherwise, held to 30 times less than it can be expected to reach."""
    strict = VerifyOptions(tolerance=Tolerance(1e-9, 1e-9))
    run, count = LoadedModel.run, itertools.count()

    def rounded(model: LoadedModel, feeds: Feeds, fetch: Any) -> Arrays:
        return run(model, feeds, fetch, jitter=[77, next(count)])

    report = verified(name, tmp_path, processes, honest, options=strict, running=rounded)
    assert report.passed is True, [f.explanation() for f in report.failures]
    assert any(f.rounding for f in report.comparisons)


def test_a_denormal_that_is_taken_for_zero_is_no_fault(tmp_path: Path, processes: RuntimePool) -> None:
    nodes = [
        *(placeholder("vector_observation"), constant("zero", 0.0)),
        node("seen", "NotEqual", "vector_observation", "zero", T=np.float32),
        node("action", "Cast", "seen", SrcT=np.bool_, DstT=np.float32),
    ]
    source = tmp_path / "seen.bytes"
    source.write_bytes(graph_bytes(nodes))

    def flushed(feeds: Feeds) -> Feeds:
        return {n: np.where(np.abs(a) < np.finfo(np.float32).tiny, 0, a).astype(a.dtype) for n, a in feeds.items()}

    def ones(feeds: Feeds) -> Feeds:
        return {n: np.where(np.abs(a) < np.finfo(np.float32).tiny, 1, a).astype(a.dtype) for n, a in feeds.items()}

    assert verified(source, tmp_path, processes, honest, flushed).passed is True
    assert verified(source, tmp_path, processes, honest, ones).passed is False  # zeros are zeros


REGIONS = {
    "rows from the 257th on": lambda x: np.arange(len(x)) >= 256,
    "the last of an odd number of rows": lambda x: np.arange(len(x)) == 258,
    "the third of three": lambda x: (np.arange(len(x)) == 2) & (len(x) == 3),
    "one number alone": lambda x: (x != 0).sum(1) == 1,
    "zeros and ones": lambda x: np.isin(x, (0, 1)).all(1) & (x.sum(1) > 1),
    "all numbers equal": lambda x: (x == x[:, :1]).all(1) & (np.abs(x[:, 0]) % 5 > 0),
    "near zero": lambda x: (np.abs(x).max(1) < 0.1) & (np.abs(x).max(1) > 1e-6),
    "large observations": lambda x: (np.abs(x) > 12).any(1) & (np.abs(x) < 900).all(1),
    "opposite extremes": lambda x: (x[:, 0] > 4) & (x[:, 5] < -4),
    "extremes before the clip": lambda x: (x[:, 0] > 2.5) & (x[:, 0] < 4.5) & (x[:, 5] < -2.5) & (x[:, 5] > -4.5),
    "one large number of some": lambda x: (x[:, 3] > 120) & (x[:, 3] < 280),
    "one large number alone": lambda x: (x[:, 3] > 12) & (np.sort(np.abs(x), 1)[:, -2] < 5),
    "beyond two thousand": lambda x: (x > 2000).any(1),
    "from zero to one": lambda x: ((x > 0) & (x < 1)).all(1),
    "far and opposite": lambda x: (x[:, 7] < -200) & (x[:, 6] > 200) & (np.abs(x) < 900).all(1),
}


@pytest.mark.parametrize("region", REGIONS)
def test_a_region_that_is_wrong_is_met(region: str, tmp_path: Path, processes: RuntimePool) -> None:
    report = verified("continuous", tmp_path, processes, where(REGIONS[region]))
    assert "action" in {f.output for f in report.failures if f.kind == "numbers"}


IMAGES = {
    "rows from the 65th on": lambda x: np.arange(len(x)) >= 64,
    "black": lambda x: (x == 0).all((1, 2, 3)),
    "white": lambda x: (x == 1).all((1, 2, 3)),
    "dim": lambda x: (x.max((1, 2, 3)) < 0.5) & (x > 0).any((1, 2, 3)),
}


@pytest.mark.parametrize("region", IMAGES)
def test_images_that_are_answered_wrongly_are_met(region: str, tmp_path: Path, processes: RuntimePool) -> None:
    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        if "value_estimate" in answers:
            (image,) = (a for a in feeds.values() if a.ndim == 4)
            answers["value_estimate"] = answers["value_estimate"] + IMAGES[region](image)[:, None].astype(np.float32)
        return answers

    report = verified("visual", tmp_path, processes, spoil)
    assert "value_estimate" in {f.output for f in report.failures if f.kind == "numbers"}


def test_a_slow_runtime_is_given_less_and_that_is_said(
    tmp_path: Path, processes: RuntimePool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(work._SPEEDS, "onnxruntime", 1e4)
    fed: list[int] = []

    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        fed.append(max(len(a) for a in feeds.values()))
        return answers

    report = verified("visual", tmp_path, processes, spoil)
    (note,) = (n for n in report.notes if "is slow" in n)
    assert note.startswith("onnx in onnxruntime is slow (")
    assert "typical, batch 67" in note
    assert report.passed is True
    assert max(fed) < 67


def test_a_memory_that_is_clipped_is_met(tmp_path: Path, processes: RuntimePool) -> None:
    def clipped(feeds: Feeds) -> Feeds:
        return {**feeds, "recurrent_in": np.clip(feeds["recurrent_in"], -3, 3)}

    report = verified("recurrent", tmp_path, processes, honest, clipped)
    assert "recurrent_out" in {f.output for f in report.failures if f.kind == "numbers"}


def test_noise_that_is_clipped_is_met(tmp_path: Path, processes: RuntimePool) -> None:
    """At 3, which a draw is beyond once in 370."""

    def clipped(feeds: Feeds) -> Feeds:
        return {**feeds, "epsilon": np.clip(feeds["epsilon"], -3, 3)} if "epsilon" in feeds else feeds

    report = verified("continuous", tmp_path, processes, honest, clipped)
    assert "action" in {f.output for f in report.failures if f.kind == "numbers"}


# ------------------------------------------------------------------ draws


def log_softmax(logits: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.asarray(logits - np.log(np.exp(logits).sum(axis=1, keepdims=True)))


def drawn(rng: np.random.Generator, log_probs: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A class for each row of log-probabilities [rows, classes]."""
    above = np.cumsum(np.exp(log_probs) / np.exp(log_probs).sum(axis=1, keepdims=True), axis=1)
    return (rng.random((len(log_probs), 1)) >= above).sum(axis=1)


def judged(
    branches: Sequence[npt.NDArray[Any]], log_probs: Sequence[npt.NDArray[Any]], runtime: str = "onnxruntime"
) -> list[Difference]:
    """What is said of classes [rows] of each branch, drawn from log-probabilities [rows, classes]."""
    who = Participant(format="onnx", runtime=runtime, run=lambda *_: [], outputs=(), model=None)  # type: ignore[arg-type]
    samplers = [Sampler(str(number), "categorical") for number in range(len(branches))]
    classes = {s.tensor: branch[:, None] for s, branch in zip(samplers, branches, strict=True)}
    odds = {s.tensor: seen_by(who, part) for s, part in zip(samplers, log_probs, strict=True)}
    return list(wrong_draws(samplers, classes, odds, who).values())


def in_turn(rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.tile(rows, (4096 // len(rows), 1))


def test_a_right_sampler_is_called_right() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        parts = [in_turn(log_softmax(rng.standard_normal((12, size)) * rng.uniform(0, 6))) for size in (3, 4)]
        found = judged([drawn(rng, part) for part in parts], parts)
        assert all(d.passed and d.max_abs < 1 - 1e-5 for d in found), found


def test_a_temperature_is_seen() -> None:
    rng = np.random.default_rng(1)
    log_probs = in_turn(log_softmax(rng.standard_normal((12, 4))))
    assert not judged([drawn(rng, log_softmax(log_probs / 0.8))], [log_probs])[0].passed


def test_a_rare_class_that_is_never_drawn_is_seen() -> None:
    rng = np.random.default_rng(2)
    log_probs = np.concatenate([rng.standard_normal((12, 3)) / 2, np.full((12, 1), -3.5)], axis=1)
    log_probs = in_turn(log_softmax(log_probs))
    classes = drawn(rng, log_probs)
    assert judged([classes], [log_probs])[0].passed
    classes[classes == 3] = 0
    assert not judged([classes], [log_probs])[0].passed


def test_branches_that_are_drawn_from_one_seed_are_seen() -> None:
    rng = np.random.default_rng(3)
    log_probs = in_turn(log_softmax(rng.standard_normal((12, 3))))
    once, again = drawn(rng, log_probs), drawn(rng, log_probs)
    assert all(d.passed for d in judged([once, again], [log_probs] * 2))
    assert "serves several" in judged([once, once], [log_probs] * 2)[0].reason


@pytest.mark.parametrize("plant", ["pairs", "halves"])
def test_rows_of_one_kind_that_hang_on_each_other_are_seen(plant: str) -> None:
    rng = np.random.default_rng(4)
    log_probs = np.tile(log_softmax(rng.standard_normal((1, 5))), (4096, 1))
    classes = drawn(rng, log_probs)
    spoiled = np.repeat(classes[::2], 2) if plant == "pairs" else np.resize(classes[:2048], 4096)
    assert "not independent" in judged([spoiled], [log_probs])[0].reason


@pytest.mark.parametrize("kind", ["normal", "uniform", "truncated normal"])
def test_numbers_of_a_sampler_are_seen_to_be_others(kind: str) -> None:
    who = Participant(format="onnx", runtime="c", run=lambda *_: [], outputs=(), model=None)  # type: ignore[arg-type]
    rng = np.random.default_rng(5)
    right = rng.random((4096, 3)) if kind == "uniform" else rng.standard_normal((4096, 3))
    while kind == "truncated normal" and (outside := np.abs(right) > 2).any():
        right[outside] = rng.standard_normal(int(outside.sum()))
    for made, passes in ((right, True), (right * 1.15, False), (right + 0.1, False), (right.round(), False)):
        assert wrong_draws([Sampler("x", kind)], {"x": made}, {}, who)["x"].passed is passes
        scaled = Sampler("x", kind, mean=3, scale=2)
        assert wrong_draws([scaled], {"x": made * 2 + 3}, {}, who)["x"].passed is passes


#: Classes [rows, branches] → those that a sampler gives that does not draw each row by itself.
DEPENDENT: dict[str, Callable[[npt.NDArray[Any]], npt.NDArray[Any]]] = {
    "in pairs": lambda a: np.repeat(a[::2], 2, axis=0)[: len(a)],
    "twice over": lambda a: np.resize(a[: (len(a) + 1) // 2], a.shape),
    "every fourth again": lambda a: np.where(np.arange(len(a))[:, None] % 4 == 3, np.roll(a, 1, axis=0), a),
}


@pytest.mark.parametrize("kind", DEPENDENT)
def test_draws_that_hang_on_each_other_are_met(kind: str, tmp_path: Path, processes: RuntimePool) -> None:
    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        return {n: DEPENDENT[kind](a) if n == "action" else a for n, a in answers.items()}

    report = verified("sampled", tmp_path, processes, spoil)
    assert [f.output for f in report.failures] == ["action"]  # rows take turns: one has the draws of another's odds
    assert report.failures[0].kind == "draws"


def test_numbers_that_hang_on_each_other_are_seen() -> None:
    rng = np.random.default_rng(4)
    right, other = rng.standard_normal((2, 4096, 3)).clip(-1, 2)
    assert _joint(ranks(right), ranks(other)) is None
    for spoiled in (np.repeat(other[::2], 2, axis=0), np.resize(other[:2048], other.shape), other[:, [0, 0, 2]]):
        assert _joint(ranks(right), ranks(spoiled)) is not None


@pytest.mark.parametrize("middles", [(0.2, 6.25), (5.0,), (6.3,), (0.2, 6.3, 6.5, -6.3)])
def test_saturated_numbers_hang_together_by_chance(middles: Sequence[float]) -> None:
    """Clipped nearly always, one draw in a thousand is another number; runtimes round the bound as they like."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        one, other = ((np.array(middles) + rng.standard_normal((4096, len(middles)))).clip(-3, 3) / 3 for _ in range(2))
        assert _joint(ranks(one), ranks(other)) is None, seed
    bound = np.ones((4096, 2))
    assert _joint(ranks(bound), ranks(np.nextafter(bound, 0))) is None


def test_numbers_that_honestly_share_their_noise_are_independent_draws() -> None:
    for seed in range(12):
        one, other = (np.random.default_rng([seed, k]).standard_normal((512, 1)).repeat(8, axis=1) for k in (1, 2))
        assert _joint(ranks(one), ranks(other)) is None, seed


def test_thousands_of_classes_are_told_from_those_that_were_drawn() -> None:
    rng = np.random.default_rng(5)
    log_probs = np.tile(log_softmax(rng.standard_normal((1, 20_000))), (512, 1))
    classes = drawn(rng, log_probs)
    assert judged([classes], [log_probs])[0].passed
    assert "rows 1 apart" in judged([np.repeat(classes[::2], 2)], [log_probs])[0].reason


@pytest.mark.parametrize("action", [1, 4, 8])
def test_an_action_whose_mask_the_sampler_ignores_is_met(action: int, tmp_path: Path, processes: RuntimePool) -> None:
    """Only what is drawn is wrong: the probabilities know the mask."""

    def ignored(model: LoadedModel, feeds: Feeds, fetch: Any) -> Arrays:
        answers = LoadedModel.run(model, feeds, fetch)
        if "action" in answers:
            masks = np.array(feeds["action_masks"])
            masks[:, action] = 1
            answers = {**answers, **LoadedModel.run(model, {**feeds, "action_masks": masks}, ["action"])}
        return answers

    report = verified("sampled", tmp_path, processes, honest, running=ignored)
    assert "action" in {f.output for f in report.failures}


def test_classes_of_another_dtype_are_met(tmp_path: Path, processes: RuntimePool) -> None:
    def narrow(feeds: Feeds, answers: Arrays) -> Arrays:
        return {n: a.astype(np.int32) if n == "action" else a for n, a in answers.items()}

    report = verified("sampled", tmp_path, processes, narrow)
    assert any("int32" in f.reason for f in report.failures if f.output == "action")


# ------------------------------------------------------------------ weights


def nearly_flat(tmp_path: Path, scale: float = 1e-3) -> Path:
    """A policy whose outputs hardly vary: all its matrices are a fraction."""
    graph = schema.parse(schema.GraphDef, fixture("continuous").read_bytes(), "GraphDef")
    for each in graph.node:
        value = each.attr["value"].tensor
        if each.op == "Const" and len(value.tensor_shape.dim) == 2:
            value.CopyFrom(from_array((to_array(value) * np.float32(scale)).astype(np.float32)))
    source = tmp_path / "small.bytes"
    source.write_bytes(schema.serialise(graph))
    return source


def test_an_output_that_hardly_varies_is_judged_by_how_far_it_does(tmp_path: Path, processes: RuntimePool) -> None:
    def flatter(feeds: Feeds, answers: Arrays) -> Arrays:
        if "value_estimate" in answers:
            mean = answers["value_estimate"].mean()
            answers["value_estimate"] = mean + (answers["value_estimate"] - mean) * np.float32(0.95)
        return answers

    source = nearly_flat(tmp_path, 0.03)  # the value varies by 6e-5
    assert verified(source, tmp_path, processes, honest).passed is True
    report = verified(source, tmp_path, processes, flatter)
    (found,) = {f.output: f for f in report.failures if f.kind == "numbers"}.values()
    assert found.max_abs_diff < 1e-5
    assert "how far it varies" in found.tolerance.reason
    loose = VerifyOptions(tolerance=Tolerance(1.1e-5, 1e-5))  # what was asked for is not made narrower
    assert verified(source, tmp_path, processes, flatter, options=loose).passed is True


@pytest.mark.parametrize("kind", FORMATS)
def test_weights_that_were_rounded_are_met_where_outputs_hardly_vary(
    kind: str, tmp_path: Path, pool: RuntimePool
) -> None:
    """Half precision moves these outputs by less than the tolerance: only the weights themselves tell."""
    source = nearly_flat(tmp_path)
    (result,) = export([source], ExportOptions(tmp_path / "out", targets=DEFAULTS, verify="none"))
    artefact = opened(kind, result.folder)
    value = artefact.constant("dense/kernel/read")
    artefact.set_constant("dense/kernel/read", value.astype(np.float16).astype(np.float32))
    artefact.save()
    report = verify_folder(result.folder, source=source, runtimes="tensorflow,onnxruntime,tfjs-cpu")
    assert report.passed is False
    assert {f.format.partition(":")[0] for f in report.failures} == {kind}
    for found in report.failures:
        assert found.bisection is not None
        assert found.bisection.tensor == "dense/kernel/read"
        assert "the constant dense/kernel/read has another value" in found.explanation()[0]


def test_a_sampler_whose_uniform_number_is_sometimes_zero_is_expected_to_draw_the_first_class() -> None:
    """TensorFlow.js' WebGL shader; what has no probability at all stays without."""
    with np.errstate(divide="ignore"):
        log_probs = np.log(np.array([[0.0, 1e-10, 1 - 1e-10]]))
    probs = np.exp(with_zeros(log_probs, 2.0**-12))[0]
    np.testing.assert_allclose(probs, [0, 1e-10 + 2.0**-12, 1 - 2.0**-12], rtol=1e-6)
    rare = np.where(np.random.default_rng(0).random(4096) < 2.0**-12, 0, 1)
    rare[0] = 0
    ordinary = np.log(np.tile([[1e-10, 1 - 1e-10]], (4096, 1)))
    assert not judged([rare], [ordinary])[0].passed
    assert judged([rare], [ordinary], "tfjs-webgl")[0].passed
