"""Causes planted in logs of six policies: each has to be named, and logs without one must raise no alarm."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from export_model.exporter.acting.policy import LoadedPolicy
from export_model.exporter.logs.check import LogReport, check_log
from export_model.signatures.roles import Role
from tests.commands import ROOT
from tests.exporting import load_policy
from tests.logs.planting import Array, Arrays, Fault, recorded

FIXTURES = ROOT / "fixtures"
#: name → source. Continuous and discrete actions, a normaliser, memories, an image, and another trainer's.
POLICIES = {
    "3DBall": FIXTURES / "trained" / "3DBall",
    "Crawler2D": FIXTURES / "trained" / "Crawler2D",
    "discrete": FIXTURES / "discrete.bytes",
    "Hallway": FIXTURES / "trained" / "Hallway",
    "ppo_box": FIXTURES / "sb3_zip" / "ppo_box.zip",
    "visual": FIXTURES / "visual.bytes",
}


@cache
def policy_of(name: str, runtime: str = "onnxruntime") -> LoadedPolicy:
    return load_policy(POLICIES[name], runtime=runtime)


def explained(policy: LoadedPolicy, log: Arrays, folder: Path) -> LogReport:
    path = folder / "run.npz"
    np.savez(path, **log)  # type: ignore[arg-type]
    return check_log(policy, path)


def vector_of(policy: LoadedPolicy) -> str:
    return next(s.name for s in policy.signature.observations if s.role is Role.VECTOR)


def on_columns(policy: LoadedPolicy, change: Callable[[Array], None]) -> Callable[[Arrays], Arrays]:
    name = vector_of(policy)

    def given(inputs: Arrays) -> Arrays:
        copy = inputs[name].copy()
        change(copy)
        return {**inputs, name: copy}

    return given


def times(column: int, factor: float) -> Callable[[Array], None]:
    def change(array: Array) -> None:
        array[:, column] *= np.float32(factor)

    return change


def plus(column: int, offset: float) -> Callable[[Array], None]:
    def change(array: Array) -> None:
        array[:, column] += np.float32(offset)

    return change


def exchange(i: int, j: int) -> Callable[[Array], None]:
    def change(array: Array) -> None:
        array[:, [i, j]] = array[:, [j, i]]

    return change


def a_step_late(actions: Array) -> Array:
    return np.concatenate([np.zeros_like(actions[:1]), actions[:-1]])


def with_pose(actions: Array) -> Array:
    return actions + np.linspace(0.1, 0.5, actions.shape[1], dtype=np.float32)


#: policy → (cause, column or output that has to be named, fault). Columns are such as the policy listens to.
Planted = tuple[str, str, Callable[[LoadedPolicy], Fault]]


def columns_of(name: str, i: int, j: int) -> list[Planted]:
    policy = policy_of(name)
    vector = vector_of(policy)
    return [
        ("unit", f"{vector}[{i}]", lambda p: Fault(on_columns(p, times(i, 180 / np.pi)))),
        ("unit", f"{vector}[{j}]", lambda p: Fault(on_columns(p, times(j, -1)))),
        ("swap", f"{vector}[{i}], {vector}[{j}]", lambda p: Fault(on_columns(p, exchange(i, j)))),
    ]


FITTED: list[tuple[str, float, float]] = [("scale", 2.5, 0.0), ("offset", 1.0, 0.37)]


def planted(name: str) -> list[Planted]:
    policy = policy_of(name)
    head = policy.signature.heads[0].name
    found: list[Planted] = []
    if name == "visual":
        (image,) = (s.name for s in policy.signature.observations if s.role is Role.VISUAL)
        flips: list[Callable[[Array], Array]] = [
            lambda a: a[:, ::-1],
            lambda a: a[:, :, ::-1],
            lambda a: a[:, ::-1, ::-1],
            lambda a: 1 - a,
        ]
        found += [
            ("image", image, lambda p, f=flip: Fault(lambda inputs: {**inputs, image: f(inputs[image])}))  # type: ignore[misc]
            for flip in flips
        ]
    else:
        size = policy.signature.input(vector_of(policy)).shape[1]
        assert size is not None
        found += columns_of(name, size // 3, size // 2)
    if policy.signature.memory is not None:
        found += [("memory", "recurrent_in", lambda p, m=m: Fault(memory=m)) for m in ("late", "dropped", "not reset")]  # type: ignore[misc]
        return found
    found.append(("lag", head, lambda p: Fault(logged=a_step_late)))
    if policy.signature.heads[0].is_continuous:
        found.append(("action_offset", head, lambda p: Fault(logged=with_pose)))
        found.append(("swap", head, lambda p: Fault(logged=lambda actions: actions[:, ::-1])))
        if name != "visual":
            column, vector = size // 3, vector_of(policy)
            found.append(("scale", f"{vector}[{column}]", lambda p: Fault(on_columns(p, times(column, 2.5)))))
            found.append(("offset", f"{vector}[{column}]", lambda p: Fault(on_columns(p, plus(column, 0.37)))))
    return found


CASES = [(name, number) for name in POLICIES for number in range(len(planted(name)))]


@pytest.mark.parametrize(("name", "number"), CASES, ids=lambda value: str(value))
def test_a_planted_cause_is_named(name: str, number: int, tmp_path: Path) -> None:
    policy = policy_of(name)
    kind, where, fault = planted(name)[number]
    log = recorded(policy, fault(policy), episodes=8, length=40)
    report = explained(policy, log, tmp_path)
    assert not report.fits
    assert [c.kind for c in report.causes] == [kind], [c.says for c in report.causes]
    assert report.causes[0].where.startswith(where)
    assert report.explained >= 0.999 * report.steps


#: Where every step is computed hundreds of times to look for a cause: 20 seconds for a camera, one seed is enough.
DEAR = {"visual", "Crawler2D"}


@pytest.mark.parametrize(
    ("name", "seed", "drawn"),
    [
        pytest.param(
            *(name, seed, drawn),
            id=f"{name}-{seed}-{'drawn' if drawn else 'deterministic'}",
            marks=[pytest.mark.slow] if drawn and name in DEAR else [],
        )
        for name in POLICIES
        for seed in (1, 2)
        for drawn in (False, True)
        if not (drawn and name in DEAR and seed > 1)
    ],
)
def test_a_log_without_a_fault_raises_no_alarm(name: str, seed: int, drawn: bool, tmp_path: Path) -> None:
    """Recorded in onnxruntime, checked in our own kernels."""
    policy = policy_of(name)
    log = recorded(policy, Fault(), episodes=3, length=20, seed=seed, drawn=drawn)
    report = explained(policy_of(name, "numpy"), log, tmp_path)
    assert report.fits, (report.causes, report.sigmas)
    assert report.drawn in (False, drawn)


@pytest.mark.parametrize(
    ("name", "kind", "fault"),
    [
        ("3DBall", "unit", lambda p: Fault(on_columns(p, times(2, 180 / np.pi)))),
        ("3DBall", "normaliser", lambda p: Fault(_normalised(p))),
        ("3DBall", "lag", lambda p: Fault(logged=a_step_late)),
        ("discrete", "swap", lambda p: Fault(on_columns(p, exchange(3, 5)))),
        ("Hallway", "memory", lambda p: Fault(memory="dropped")),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_cause_is_named_where_actions_were_drawn(
    name: str, kind: str, fault: Callable[[LoadedPolicy], Fault], tmp_path: Path
) -> None:
    policy = policy_of(name)
    log = recorded(policy, fault(policy), episodes=8, length=40, drawn=True)
    report = explained(policy, log, tmp_path)
    assert report.drawn
    assert [c.kind for c in report.causes] == [kind]


def _normalised(policy: LoadedPolicy) -> Callable[[Arrays], Arrays]:
    name = vector_of(policy)
    given = policy.signature.input(name).distribution
    assert given is not None
    mean, std = np.asarray(given["mean"], np.float32), np.asarray(given["std"], np.float32)
    return lambda inputs: {**inputs, name: np.clip((inputs[name] - mean) / std, -5, 5)}


def test_several_columns_in_degrees_are_all_named(tmp_path: Path) -> None:
    policy = policy_of("3DBall")

    def given(array: Array) -> None:
        array[:, [2, 4]] *= np.float32(180 / np.pi)

    report = explained(policy, recorded(policy, Fault(on_columns(policy, given))), tmp_path)
    assert sorted(c.where for c in report.causes) == ["state[2]", "state[4]"]
    assert report.explained == report.steps


def test_what_no_cause_explains_is_said_to_be_unexplained(tmp_path: Path) -> None:
    policy = policy_of("3DBall")
    rng = np.random.default_rng(0)
    report = explained(policy, recorded(policy, Fault(logged=lambda a: rng.uniform(-3, 3, a.shape))), tmp_path)
    assert not report.fits
    assert report.causes == ()


@pytest.mark.parametrize("share", [0.5, 0.76, 0.95])
def test_a_log_that_was_not_drawn_is_not_judged_as_drawn(share: float, tmp_path: Path) -> None:
    """Most steps are the action without chance to the last digit, which no draw is; the others are off."""
    policy = policy_of("3DBall")
    log = recorded(policy, Fault(), episodes=8, length=50)
    rng = np.random.default_rng(0)
    off = rng.random(400) > share
    spread = rng.normal(0, 0.5, log["action"].shape) * off[:, None]
    report = explained(policy, {**log, "action": (log["action"] + spread).astype(np.float32).clip(-1, 1)}, tmp_path)
    assert not report.fits and not report.drawn
    assert report.misfits.sum() >= 0.9 * off.sum()


@pytest.mark.parametrize("free", [0, 3], ids=["every step forbids", "each third step allows all"])
def test_an_inverted_mask_is_named(free: int, tmp_path: Path) -> None:
    policy = policy_of("discrete")
    log = recorded(policy, Fault(), episodes=8, length=40)
    rng = np.random.default_rng(0)
    masks = np.ones_like(log["action_masks"])
    start = 0
    for size in policy.signature.branches:  # one action of each branch is forbidden, another allowed
        masks[np.arange(len(masks)), start + rng.integers(0, size, len(masks))] = 0
        start += size
    logged = 1 - masks
    if free:
        masks[::free] = logged[::free] = 1
    decided = policy.decide(log[vector_of(policy)], masks=masks, deterministic=True)
    report = explained(policy, {**log, "action_masks": logged, "action": decided.action}, tmp_path)
    assert [(c.kind, c.says) for c in report.causes] == [("mask", "the mask was inverted")]
