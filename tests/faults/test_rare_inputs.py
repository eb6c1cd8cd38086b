"""Faults that show for a few inputs only: masks that forbid one action, some batches, pictures with structure."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from export_model.converters.files.children.process import LoadedModel
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.participants import Feeds
from tests.faults.test_blind_spots import Arrays, honest, verified
from tests.handmade import constant, dense, graph_bytes, node, placeholder

Rows = npt.NDArray[Any]


# ------------------------------------------------------------------ masks


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("seed", range(3))
def test_forbidden_actions_that_are_drawn_are_met(
    count: int, seed: int, tmp_path: Path, processes: RuntimePool
) -> None:
    """The sampler forgets the mask where one action is forbidden, or two, and knows every other mask."""

    def forgetful(model: LoadedModel, feeds: Feeds, fetch: Any) -> Arrays:
        answers = LoadedModel.run(model, feeds, fetch)
        if "action" in answers:
            masks = np.array(feeds["action_masks"])
            masks[(masks == 0).sum(axis=1) == count] = 1
            answers = {**answers, **LoadedModel.run(model, {**feeds, "action_masks": masks}, ["action"])}
        return answers

    report = verified("sampled", tmp_path, processes, honest, running=forgetful, options=VerifyOptions(seed=seed))
    assert "action" in {f.output for f in report.failures}


@pytest.mark.parametrize("fixture", ["sampled", "discrete"])
@pytest.mark.parametrize("action", [0, 2, 5, 8])
def test_a_mask_that_is_not_read_where_it_forbids_one_action_is_met(
    action: int, fixture: str, tmp_path: Path, processes: RuntimePool
) -> None:
    def deaf(feeds: Feeds) -> Feeds:
        if "action_masks" not in feeds:
            return feeds
        masks = np.array(feeds["action_masks"])
        masks[(masks == 0).sum(axis=1) == 1, action] = 1
        return {**feeds, "action_masks": masks}

    report = verified(fixture, tmp_path, processes, honest, deaf)
    assert report.failures


# ------------------------------------------------------------------ batches

BATCHES: dict[str, Callable[[int], bool]] = {
    "of 32": lambda n: n == 32,
    "of 64": lambda n: n == 64,
    "of a multiple of 16": lambda n: n % 16 == 0,
    "of 48": lambda n: n == 48,
    "above 512": lambda n: n > 512,
}


@pytest.mark.parametrize("batch", BATCHES)
def test_rows_that_are_mixed_in_batches_are_met(batch: str, tmp_path: Path, processes: RuntimePool) -> None:
    def mixed(feeds: Feeds, answers: Arrays) -> Arrays:
        return {n: np.roll(a, 1, axis=0) if BATCHES[batch](len(a)) else a for n, a in answers.items()}

    report = verified("continuous", tmp_path, processes, mixed)
    assert "value_estimate" in {f.output for f in report.failures if f.kind == "numbers"}


# ------------------------------------------------------------------ pictures


def camera_and_vector() -> bytes:
    """``action`` = tanh(A·picture + B·x): [B, 6, 6, 2] and [B, 3]."""
    nodes = [
        placeholder("visual_observation_0", (None, 6, 6, 2)),
        placeholder("vector_observation"),
        constant("flat/shape", np.array([-1, 72], np.int32)),
        node("flat", "Reshape", "visual_observation_0", "flat/shape", T=np.float32, Tshape=np.int32),
        *dense("left", "flat", 72, 2),
        *dense("right", "vector_observation", 3, 2),
        node("sum", "Add", "left", "right", T=np.float32),
        node("action", "Tanh", "sum", T=np.float32),
    ]
    return graph_bytes(nodes)


#: Pictures [B, 6, 6, 2] and vectors [B, 3] → the rows whose action is wrong.
SEEN: dict[str, Callable[[Rows, Rows], Rows]] = {
    "a black half beside a picture": lambda x, v: (x[:, :, :3] == 0).all((1, 2, 3)) & x.any((1, 2, 3)),
    "a black upper half": lambda x, v: (x[:, :3] == 0).all((1, 2, 3)) & x.any((1, 2, 3)),
    "one channel": lambda x, v: (x[..., 1] == 0).all((1, 2)) & x.any((1, 2, 3)),
    "a smooth picture": lambda x, v: (
        (np.abs(np.diff(x, axis=1)).max((1, 2, 3)) < 0.4) & (np.ptp(x, axis=(1, 2, 3)) > 0.6)
    ),
    "one object": lambda x, v: np.array([len(np.unique(each)) == 2 and 0.05 < each.mean() < 0.95 for each in x]),
    "brighter on the left": lambda x, v: x[:, :, :3].mean((1, 2, 3)) > x[:, :, 3:].mean((1, 2, 3)) + 0.3,
    "one number of the vector alone": lambda x, v: (v != 0).sum(1) == 1,
    "a vector of zeros and ones": lambda x, v: np.isin(v, (0, 1)).all(1) & (v.sum(1) > 1),
    "a vector of equal numbers": lambda x, v: (v == v[:, :1]).all(1) & (np.abs(v[:, 0]) % 5 > 0),
    "a vector near zero": lambda x, v: (np.abs(v).max(1) < 0.1) & (np.abs(v).max(1) > 1e-6),
    "a vector of whole numbers": lambda x, v: (v == np.rint(v)).all(1) & (np.abs(v).max(1) > 1) & (v.max(1) < 10),
    "a vector from zero to one": lambda x, v: ((v > 0) & (v < 1)).all(1) & (np.ptp(v, axis=1) > 0.1),
    "one large number": lambda x, v: (np.abs(v).max(1) > 12) & (np.sort(np.abs(v), 1)[:, -2] < 5),
    "the last of 32 rows": lambda x, v: (np.arange(len(v)) == 31) & (len(v) == 32),
    "the first of 64 rows": lambda x, v: (np.arange(len(v)) == 0) & (len(v) == 64),
}


@pytest.mark.parametrize("region", SEEN)
def test_what_is_seen_beside_a_vector_is_met(region: str, tmp_path: Path, processes: RuntimePool) -> None:
    source = tmp_path / "seen.bytes"
    source.write_bytes(camera_and_vector())

    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        if "action" in answers:
            (image,) = (a for a in feeds.values() if a.ndim == 4)
            (vector,) = (a for n, a in feeds.items() if a.ndim == 2 and a.shape[1] == 3)
            answers["action"] = answers["action"] + 0.1 * SEEN[region](image, vector)[:, None].astype(np.float32)
        return answers

    assert verified(source, tmp_path, processes, honest).passed is True
    report = verified(source, tmp_path, processes, spoil)
    assert "action" in {f.output for f in report.failures if f.kind == "numbers"}
