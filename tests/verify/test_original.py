"""The source as the reference: what it is fed, what is taken from it, what follows from its numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from msgspec.structs import replace

from export_model.converters.files.children.process import RunFailedError
from export_model.exporter.verify.original import MAX_ROWS, Original
from export_model.signatures.memories import SourcePart
from export_model.signatures.roles import Role
from export_model.signatures.spec import Memory, PolicySignature, SourceMap, TensorSpec

Array = npt.NDArray[Any]
Arrays = Mapping[str, Array]
B = None
STATE = TensorSpec("state", Role.VECTOR, "float32", (B, 2), "x:0")
X = np.array([[1, 2], [3, -4], [0, 5]], np.float32)


class Source:
    """A source whose tensors are what ``compute`` makes of what it is fed; it keeps what that was."""

    def __init__(self, compute: Callable[[Arrays], Arrays]) -> None:
        self.compute = compute
        self.fed: list[Arrays] = []
        self.asked: list[list[str]] = []

    def run(self, feeds: Arrays, fetch: Sequence[str]) -> dict[str, Array]:
        self.fed.append(feeds)
        self.asked.append(list(fetch))
        made = self.compute(feeds)
        return {n: made[n] for n in fetch}

    def run_all(self, inputs: Sequence[Arrays], fetch: Sequence[str]) -> list[dict[str, Array]]:
        return [self.run(feeds, fetch) for feeds in inputs]


def out(name: str, role: Role, width: int, dtype: str = "float32", source: Any = None) -> TensorSpec:
    return TensorSpec(name, role, dtype, (B, width), source)


def signature(
    outputs: Sequence[TensorSpec], inputs: Sequence[TensorSpec] = (), space: str = "continuous", **more: Any
) -> PolicySignature:
    return PolicySignature(
        inputs=(STATE, *inputs), outputs=tuple(outputs), family="own model", action_space=space, **more
    )


def original(
    source: Source, signed: PolicySignature, fetches: Mapping[str, str], feeds: Mapping[str, str] = {}, **more: Any
) -> Original:
    mapped = SourceMap({"state": "x:0", **feeds}, fetches, **more)
    return Original(source, signed, mapped)  # type: ignore[arg-type]


ACTION, PLAIN = out("action", Role.CONTINUOUS, 2), out("deterministic_action", Role.DETERMINISTIC, 2)
NOISE = TensorSpec("epsilon", Role.NOISE, "float32", (B, 2), "n:0")


def noisy(feeds: Arrays) -> Arrays:
    return {"y:0": 2 * feeds["x:0"] + feeds["n:0"]}


def test_an_action_without_chance_is_run_with_noise_of_zero() -> None:
    source, epsilon = Source(noisy), np.full((3, 2), 7, np.float32)
    made = original(
        source, signature([ACTION, PLAIN], [NOISE]), {"action": "y:0"}, {"epsilon": "n:0"}, noise={"n:0": (B, 2)}
    )
    assert made.output_names == {"action", "deterministic_action"}
    answers = made.run({"state": X, "epsilon": epsilon})
    np.testing.assert_array_equal(answers["action"], 2 * X + 7)
    np.testing.assert_array_equal(answers["deterministic_action"], 2 * X)
    assert len(source.fed) == 2


@pytest.mark.parametrize("kept", [False, True])
def test_noise_that_the_policy_is_not_fed_is_zero_or_drawn(kept: bool) -> None:
    source = Source(noisy)
    made = original(source, signature([ACTION, PLAIN]), {"action": "y:0"}, noise={"n:0": (B, 2)}, noise_kept=kept)
    answers = [made.run({"state": X}) for _ in range(2)]
    assert bool((answers[0]["action"] == 2 * X).all()) is not kept
    assert bool((answers[0]["action"] == answers[1]["action"]).all()) is not kept
    np.testing.assert_array_equal(answers[0]["deterministic_action"], 2 * X)
    assert source.fed[0]["n:0"].shape == (3, 2) and source.fed[0]["n:0"].dtype == np.float32


def test_without_noise_the_action_is_its_own_companion() -> None:
    source = Source(lambda feeds: {"y:0": 2 * feeds["x:0"]})
    answers = original(source, signature([ACTION, PLAIN]), {"action": "y:0"}).run({"state": X})
    assert answers["deterministic_action"] is answers["action"] and len(source.fed) == 1


def test_noise_is_laid_out_as_the_source_draws_it() -> None:
    source = Source(lambda feeds: {"y:0": feeds["n:0"].T.copy()})
    made = original(source, signature([ACTION], [NOISE]), {"action": "y:0"}, {"epsilon": "n:0"}, noise={"n:0": (2, B)})
    np.testing.assert_array_equal(made.run({"state": X, "epsilon": 3 * X})["action"], 3 * X)


def test_what_the_policy_no_longer_has_is_fed() -> None:
    source = Source(lambda feeds: {"y:0": feeds["x:0"]})
    made = original(
        source,
        signature([ACTION]),
        {"action": "y:0"},
        fixed={"one:0": np.float32(4), "row:0": np.array([[1, 2, 3]])},
        fixed_rows=("row:0",),
        batch_sizes={"batch:0": 0, "batches:0": 1},
    )
    made.run({"state": X})
    (fed,) = source.fed
    assert fed["one:0"] == 4 and fed["row:0"].tolist() == [[1, 2, 3]] * 3
    assert fed["batch:0"].shape == () and fed["batch:0"] == 3 and fed["batches:0"].tolist() == [3]
    assert fed["batch:0"].dtype == np.int32


def test_memories_of_several_parts_are_one_row() -> None:
    kept = TensorSpec("recurrent_in", Role.MEMORY_IN, "float32", (B, 3))
    given = TensorSpec("recurrent_out", Role.MEMORY_OUT, "float32", (B, 3))
    parts = {
        "recurrent_in": (SourcePart("h:0", (1, B, 2)), SourcePart("c:0", (1, B, 1))),
        "recurrent_out": (SourcePart("h_out:0", (1, B, 2)), SourcePart("c_out:0", (1, B, 1))),
    }
    source = Source(lambda feeds: {"y:0": feeds["x:0"], "h_out:0": feeds["h:0"] + 10, "c_out:0": feeds["c:0"] + 20})
    memory = Memory(size=3, input="recurrent_in", output="recurrent_out")
    signed = signature([ACTION, given], [kept], memory=memory)
    made = original(source, signed, {"action": "y:0"}, parts=parts)
    assert made.output_names == {"action", "recurrent_out"}
    rows = np.arange(9, dtype=np.float32).reshape(3, 3)
    np.testing.assert_array_equal(
        made.run({"state": X, "recurrent_in": rows})["recurrent_out"], rows + np.array([10, 10, 20])
    )
    assert source.fed[0]["h:0"].shape == (1, 3, 2) and "recurrent_in" not in source.fed[0]


def test_a_memory_of_one_agent_has_no_rows() -> None:
    kept = TensorSpec("recurrent_in", Role.MEMORY_IN, "float32", (B, 2))
    given = TensorSpec("recurrent_out", Role.MEMORY_OUT, "float32", (B, 2))
    parts = {"recurrent_in": (SourcePart("h:0", (B, 2)),), "recurrent_out": (SourcePart("h_out:0", (B, 2)),)}
    source = Source(lambda feeds: {"h_out:0": feeds["h:0"][0] + 10})
    signed = signature([given], [kept], memory=Memory(size=2, input="recurrent_in", output="recurrent_out"))
    answers = original(source, signed, {}, parts=parts, rows=1).run({"state": X, "recurrent_in": X})
    np.testing.assert_array_equal(answers["recurrent_out"], X + 10)


# ------------------------------------------------------------------ classes

LOGITS = np.array([[1, 3, 2, 0, 5], [9, -9, 0, 4, 1], [0, 0, 8, 2, 3]], np.float32)
CHOICES = [[1, 1], [0, 0], [2, 1]]
SAMPLED = TensorSpec("action", Role.SAMPLED, "int64", (B, 2))
LOG_PROBS = out("action_log_probs", Role.LOG_PROBS, 5)
BEST = TensorSpec("deterministic_action", Role.DETERMINISTIC, "int64", (B, 2))


def logits(feeds: Arrays) -> Arrays:
    rows = len(feeds["x:0"])
    made = {"a:0": LOGITS[:rows, :3], "b:0": LOGITS[:rows, 3:], "p:0": LOGITS[:rows], "drawn:0": np.zeros((rows, 2))}
    return {**made, "q:0": LOGITS[:rows], "best:0": np.array(CHOICES)[:rows].astype(np.int32)}


def test_odds_and_the_best_classes_follow_from_logits() -> None:
    source = Source(logits)
    signed = signature([SAMPLED, LOG_PROBS, BEST], space="discrete", branches=(3, 2))
    made = original(source, signed, {"action": "drawn:0"}, branches=("a:0", "b:0"))
    assert made.output_names == {"action_log_probs", "deterministic_action"}, "draws are no numbers"
    answers = made.run({"state": X})
    assert answers.keys() == {"action_log_probs", "deterministic_action"}
    assert answers["deterministic_action"].tolist() == CHOICES and answers["deterministic_action"].dtype == np.int64
    odds = np.exp(answers["action_log_probs"].astype(np.float64))
    np.testing.assert_allclose([odds[:, :3].sum(1), odds[:, 3:].sum(1)], 1, rtol=1e-6)
    np.testing.assert_allclose(np.log(odds[:, 1] / odds[:, 0]), LOGITS[:, 1] - LOGITS[:, 0], rtol=1e-4)
    np.testing.assert_allclose(np.log(odds[:, 4] / odds[:, 3]), LOGITS[:, 4] - LOGITS[:, 3], rtol=1e-4)
    assert answers["action_log_probs"].dtype == np.float32 and "drawn:0" not in source.asked[0]


def test_what_the_source_gives_is_not_derived() -> None:
    source = Source(logits)
    signed = signature([SAMPLED, LOG_PROBS, BEST], space="discrete", branches=(3, 2))
    fetches = {"action_log_probs": "p:0", "deterministic_action": "best:0"}
    answers = original(source, signed, fetches, branches=("a:0", "b:0")).run({"state": -X})
    assert answers["action_log_probs"].tolist() == LOGITS.tolist()


def test_large_logits_have_odds() -> None:
    source = Source(lambda feeds: {"a:0": np.array([[1000, 1001, -1000]], np.float32), "b:0": np.zeros((1, 2))})
    signed = signature([SAMPLED, LOG_PROBS], space="discrete", branches=(3, 2))
    (odds,) = original(source, signed, {}, branches=("a:0", "b:0")).run({"state": X[:1]})["action_log_probs"]
    np.testing.assert_allclose(odds, [-1.313262, -0.313262, -2001.313262, -0.693147, -0.693147], rtol=1e-6)


@pytest.mark.parametrize("tensors", [(), ("a:0", None)])
def test_without_all_logits_nothing_follows(tensors: tuple[str | None, ...]) -> None:
    signed = signature([SAMPLED, LOG_PROBS, BEST], space="discrete", branches=(3, 2))
    made = original(Source(logits), signed, {}, branches=tensors)
    assert made.output_names == frozenset() and made.run({"state": X}) == {}


@pytest.mark.parametrize("role", [Role.LOG_PROBS, Role.PROBS])
def test_the_best_classes_follow_from_scores(role: Role) -> None:
    signed = signature([out("action", role, 5), BEST], space="discrete", branches=(3, 2))
    answers = original(Source(logits), signed, {"action": "p:0"}).run({"state": X})
    assert answers["deterministic_action"].tolist() == CHOICES
    assert original(Source(logits), signed, {"action": "p:0"}).output_names == {"action", "deterministic_action"}
    assert original(Source(logits), signed, {}).output_names == frozenset()
    bare = signature([out("action", role, 5), BEST], space="discrete")
    assert original(Source(logits), bare, {"action": "p:0"}).output_names == {"action"}, "of unknown branches"


def test_choices_are_of_one_width() -> None:
    chosen = TensorSpec("action", Role.DETERMINISTIC, "int64", (B, 2), "best:0")
    signed = signature([chosen, BEST], space="discrete", branches=(3, 2))
    answers = original(Source(logits), signed, {"action": "best:0"}).run({"state": X})
    assert answers["deterministic_action"].tolist() == CHOICES and answers["deterministic_action"].dtype == np.int64


def test_the_action_is_the_best_value_where_the_source_has_no_other() -> None:
    chosen = TensorSpec("action", Role.DETERMINISTIC, "int64", (B, 1))
    values = out("q_values", Role.Q_VALUES, 5)
    signed = signature([chosen, values], space="discrete", branches=(5,))
    made = original(Source(logits), signed, {"q_values": "q:0"})
    assert made.output_names == {"action", "q_values"}
    assert made.run({"state": X})["action"].tolist() == [[4], [0], [2]]
    assert original(Source(logits), signed, {}).output_names == frozenset()
    both = signature([chosen, values, replace(chosen, name="deterministic_action")], space="discrete", branches=(5,))
    answers = original(Source(logits), both, {"q_values": "q:0"}).run({"state": X})
    assert answers["deterministic_action"].tolist() == [[4], [0], [2]]
    third = replace(chosen, name="action", source="drawn:0")
    told = signature([third, values, replace(chosen, name="deterministic_action")], space="discrete", branches=(5,))
    answers = original(Source(logits), told, {"q_values": "q:0", "action": "drawn:0"}).run({"state": X})
    assert not answers["deterministic_action"].any(), "what it does, whatever its values"
    own = signature([TensorSpec("action", Role.DETERMINISTIC, "int64", (B, 1), "z:0"), values], space="discrete")
    assert original(Source(logits), own, {"q_values": "q:0"}).output_names == {"q_values"}, "it has its own"
    numbers = signature([out("action", Role.DETERMINISTIC, 1), values])
    assert original(Source(logits), numbers, {"q_values": "q:0"}).output_names == {"q_values"}


# ------------------------------------------------------------------ rows


@pytest.mark.parametrize(("rows", "asked"), [(None, [3]), (3, [3]), (2, [2, 2]), (1, [1, 1, 1]), (4, [4])])
def test_a_source_is_run_so_many_rows_at_a_time(rows: int | None, asked: list[int]) -> None:
    source = Source(lambda feeds: {"y:0": 2 * feeds["x:0"]})
    made = original(source, signature([ACTION]), {"action": "y:0"}, rows=rows)
    for answers, wanted in zip(made.run_all([{"state": X}, {"state": X[:1]}]), (2 * X, 2 * X[:1]), strict=True):
        np.testing.assert_array_equal(answers["action"], wanted)
    first = [len(f["x:0"]) for f in source.fed][: len(asked)]
    assert first == asked
    if rows == 4:
        assert source.fed[0]["x:0"].tolist() == [*X.tolist(), X[-1].tolist()], "the last row again"


def test_a_source_of_one_agent_has_no_rows() -> None:
    source = Source(lambda feeds: {"y:0": 2 * feeds["x:0"][0], "z:0": feeds["x:0"].sum()})
    value = TensorSpec("value_estimate", Role.VALUE, "float32", (B, 1))
    made = original(source, signature([ACTION, value]), {"action": "y:0", "value_estimate": "z:0"}, rows=1)
    answers = made.run({"state": X})
    np.testing.assert_array_equal(answers["action"], 2 * X)
    np.testing.assert_array_equal(answers["value_estimate"], X.sum(axis=1, keepdims=True))
    turned = Source(lambda feeds: {"y:0": feeds["x:0"].T})
    assert original(turned, signature([ACTION]), {"action": "y:0"}, rows=1).run({"state": X[:1]})["action"].shape == (
        2,
        1,
    )
    many = original(source, signature([ACTION]), {"action": "y:0"})
    assert many.run({"state": X})["action"].shape == (2,), "a fault of many rows is compared as it is"


@pytest.mark.parametrize(("rows", "right"), [(0, False), (1, True), (MAX_ROWS, True), (MAX_ROWS + 1, False)])
def test_no_source_takes_any_number_of_rows(rows: int, right: bool) -> None:
    assert MAX_ROWS == 65536
    source = Source(lambda feeds: {})
    if right:
        original(source, signature([ACTION]), {}, rows=rows)
        return
    with pytest.raises(RunFailedError, match=f"{rows} rows"):
        original(source, signature([ACTION]), {}, rows=rows)


def test_what_the_policy_computes_beside_its_source_is_applied() -> None:
    source = Source(lambda feeds: {"y:0": 2 * feeds["x:0"]})
    mapped = SourceMap({"state": "x:0"}, {"action": "y:0"})
    made = Original(source, signature([ACTION]), mapped, lambda answers: {n: a + 1 for n, a in answers.items()})  # type: ignore[arg-type]
    np.testing.assert_array_equal(made.run({"state": X})["action"], 2 * X + 1)
