"""Recorded samples: what is read from the archive, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from export_model.exporter.export.sources import read_source
from export_model.exporter.verify.golden import read_golden
from export_model.signatures.errors import UsageError
from export_model.signatures.spec import PolicySignature
from fixtures import path as fixture


def signature(name: str) -> PolicySignature:
    return read_source(fixture(name)).policies()[0].signature


@pytest.fixture(scope="module")
def recurrent() -> PolicySignature:
    return signature("recurrent")


def save(folder: Path, **arrays: np.ndarray) -> Path:
    file = folder / "golden.npz"
    np.savez(file, **arrays)  # type: ignore[arg-type]
    return file


def rows(signature: PolicySignature, count: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {s.name: rng.random((count, *(n or 1 for n in s.shape[1:]))).astype(s.dtype) for s in signature.inputs}


@settings(deadline=None, max_examples=20)
@given(count=st.integers(1, 200))
def test_every_row_is_run_once_in_order(tmp_path_factory: pytest.TempPathFactory, count: int) -> None:
    spec = signature("continuous")
    arrays = rows(spec, count)
    answers = np.arange(count * 2, dtype=np.float32).reshape(count, 2)
    file = save(tmp_path_factory.mktemp("golden"), action=answers, **arrays)
    golden = read_golden(file, spec)
    assert sum(c.batch for c in golden.cases) == count
    for name, array in arrays.items():
        assert np.array_equal(np.concatenate([c.feeds[name] for c in golden.cases]), array)
    assert np.array_equal(np.concatenate([a["action"] for a in golden.answers]), answers)
    assert all(len(next(iter(c.feeds.values()))) == c.batch for c in golden.cases)


def test_the_sources_names_do_as_well_and_dtypes_are_brought_round(tmp_path: Path) -> None:
    spec = signature("discrete")
    arrays = rows(spec, 3)
    told = {(s.source if isinstance(s.source, str) else s.name): arrays[s.name].astype(np.float64) for s in spec.inputs}
    (case,) = read_golden(save(tmp_path, **told), spec).cases
    assert {n: a.dtype.name for n, a in case.feeds.items()} == {s.name: s.dtype for s in spec.inputs}


def test_what_an_episode_starts_with_may_be_left_out(tmp_path: Path, recurrent: PolicySignature) -> None:
    assert recurrent.memory is not None and recurrent.memory.input is not None
    arrays = rows(recurrent, 2)
    left = {n: a for n, a in arrays.items() if n not in (recurrent.memory.input, "action_masks")}
    (case,) = read_golden(save(tmp_path, **left), recurrent).cases
    assert not case.feeds[recurrent.memory.input].any()
    if "action_masks" in arrays:
        assert case.feeds["action_masks"].all()


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    spec = signature("discrete")
    arrays = rows(spec, 3)
    observation = spec.observations[0].name
    for change, words in (
        ({"extra": np.zeros(3)}, "'extra' is not an input or output"),
        ({observation: np.zeros((3, 99), np.float32)}, "is wanted"),
        ({observation: arrays[observation][:2]}, "the same number of rows"),
        ({observation: np.array([["a"] * arrays[observation].shape[1]] * 3)}, "is wanted"),
    ):
        with pytest.raises(UsageError, match=words):
            read_golden(save(tmp_path, **{**arrays, **change}), spec)
    del arrays[observation]
    with pytest.raises(UsageError, match="was not recorded"):
        read_golden(save(tmp_path, **arrays), spec)


def test_what_is_no_archive_is_refused(tmp_path: Path, recurrent: PolicySignature) -> None:
    one = tmp_path / "one.npy"
    np.save(one, np.zeros(3))
    text = tmp_path / "text.npz"
    text.write_text("state,action\n")
    pickled = tmp_path / "pickled.npz"
    np.savez(pickled, state=np.array([{}], dtype=object))
    cut = tmp_path / "cut.npz"
    cut.write_bytes(save(tmp_path, **rows(recurrent, 3)).read_bytes()[:-40])
    for file in (one, text, pickled, cut, tmp_path / "missing.npz"):
        with pytest.raises(UsageError, match="--golden"):
            read_golden(file, recurrent)
