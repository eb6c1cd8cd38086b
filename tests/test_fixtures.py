"""The committed policies: what the manifest says of them holds, they are lively, and TensorFlow still agrees.

Only child processes load TensorFlow here.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import itertools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fixtures import FIXTURES, FOLDER, path
from fixtures.goldens import read_npz, write_npz
from fixtures.liveliness import best_choices, constant_outputs, forbidden_choices, lopsided_choices, saturated_actions

Array = npt.NDArray[Any]

MANIFEST: dict[str, Any] = json.loads(path("manifest.json").read_text(encoding="utf-8"))
ENTRIES: dict[str, dict[str, Any]] = MANIFEST["fixtures"]
BRAINS = [(name, scope) for name in FIXTURES for scope in ENTRIES[name]["brains"]]

#: Golden runs are few rows, and in some of them the noise or the masks differ too.
ROWS_SPREAD = 0.05

needs_tensorflow = pytest.mark.skipif(
    importlib.util.find_spec("tensorflow") is None,
    reason="TensorFlow is not installed; get it with: pip install tensorflow-cpu",
)


def goldens(name: str) -> dict[str, Array]:
    return read_npz(path(f"{name}.npz"))


def over_runs(values: dict[str, Array], kind: str, node: str) -> Array:
    """The rows of a node in all runs, one after the other."""
    return np.concatenate([v for key, v in values.items() if key.split("/", 2)[1:] == [kind, node]])


def run_module(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", *arguments], cwd=FOLDER.parent, capture_output=True, encoding="utf-8", check=False
    )


# ------------------------------------------------------------------ manifest


def test_manifest_lists_the_fixtures() -> None:
    assert tuple(ENTRIES) == FIXTURES
    assert MANIFEST["tensorflow"]


@pytest.mark.parametrize("name", FIXTURES)
def test_files_are_those_of_the_manifest(name: str) -> None:
    assert set(ENTRIES[name]["files"]) == {f"{name}.bytes", f"{name}.npz"}
    for file, facts in ENTRIES[name]["files"].items():
        data = path(file).read_bytes()
        assert (hashlib.sha256(data).hexdigest(), len(data)) == (facts["sha256"], facts["bytes"]), file


@pytest.mark.parametrize("name", FIXTURES)
def test_graphs_are_small(name: str) -> None:
    assert path(name).stat().st_size < 100_000


@pytest.mark.parametrize("name", FIXTURES)
def test_goldens_have_the_tensors_of_the_manifest(name: str) -> None:
    values, entry = goldens(name), ENTRIES[name]
    kinds = {"in": entry["inputs"], "out": entry["outputs"], "rand": entry["samplers"]}
    expected = {f"{run}/{kind}/{t['name']}": t for run in entry["runs"] for kind, ts in kinds.items() for t in ts}
    assert values.keys() == expected.keys()
    for key, tensor in expected.items():
        value, shape = values[key], tensor["shape"]
        assert value.dtype.name == tensor["dtype"], key
        assert value.ndim == len(shape), key
        assert all(wanted in (None, size) for wanted, size in zip(shape, value.shape, strict=True)), key


@pytest.mark.parametrize("name", FIXTURES)
def test_runs_have_batches_1_3_and_7(name: str) -> None:
    values = goldens(name)
    node = ENTRIES[name]["outputs"][0]["name"]
    assert [len(values[f"{run}/out/{node}"]) for run in ("b1", "b3", "b7")] == [1, 3, 7]


def test_memory_is_handed_from_step_to_step() -> None:
    values, steps = goldens("recurrent"), ENTRIES["recurrent"]["sequences"]["b2s4"]
    assert not values["step0/in/recurrent_in"].any()
    for before, after in itertools.pairwise(steps):
        np.testing.assert_array_equal(values[f"{after}/in/recurrent_in"], values[f"{before}/out/recurrent_out"])
    assert ENTRIES["recurrent"]["constants"]["memory_size"] == values["b1/out/recurrent_out"].shape[1]


def test_path_knows_the_fixtures_only() -> None:
    assert path("visual") == FOLDER / "visual.bytes"
    assert path("visual.npz") == FOLDER / "visual.npz"
    with pytest.raises(ValueError, match="unknown fixture 'nothing'"):
        path("nothing")


# ------------------------------------------------------------------ liveliness


@pytest.mark.parametrize("name", FIXTURES)
def test_outputs_vary(name: str) -> None:
    values = goldens(name)
    for tensor in ENTRIES[name]["outputs"]:
        rows = over_runs(values, "out", tensor["name"])
        assert constant_outputs(tensor["name"], rows, ROWS_SPREAD) == []


@pytest.mark.parametrize(("name", "scope"), BRAINS)
def test_actions_are_lively(name: str, scope: str) -> None:
    values, brain, node = goldens(name), ENTRIES[name]["brains"][scope], f"{scope}action"
    action = over_runs(values, "out", node)
    if brain["action"] == "continuous":
        assert saturated_actions(node, action) == []
        return
    masks = over_runs(values, "in", f"{scope}action_masks")
    choices = action if brain["action"] == "sampled" else best_choices(action, brain["branches"])
    assert forbidden_choices(node, choices, masks, brain["branches"]) == []
    assert all(len(np.unique(column)) > 1 for column in choices.T)
    assert 0 < masks.mean() < 1
    if brain["action"] == "log_probs":
        # Not only the masks move it: what is allowed varies too.
        allowed = np.where(masks > 0, action, np.nan)
        assert (np.nanstd(allowed, axis=0) >= ROWS_SPREAD).all()


def test_a_dull_policy_is_noticed() -> None:
    rows = np.linspace(-1, 1, 100, dtype=np.float32)[:, None]
    assert constant_outputs("a", rows) == []
    assert constant_outputs("a", 0.01 * rows) == ["a[:, 0] has a standard deviation of 0.00583"]
    assert constant_outputs("a", np.where(rows > 0.9, np.nan, rows)) == ["a is not finite everywhere"]
    assert saturated_actions("a", rows) == []
    assert saturated_actions("a", np.clip(2 * rows, -1, 1)) == ["50% of a is at its clip"]
    choices = np.arange(100)[:, None] % 2
    assert lopsided_choices("a", choices, (2,)) == []
    assert lopsided_choices("a", choices, (3,)) == ["a: branch 0 takes its actions with shares [0.5, 0.5, 0.0]"]
    assert lopsided_choices("a", choices, (1,)) == ["a: branch 0 has 1 actions, but number 1 was taken"]
    masks = np.tile(np.asarray([[1.0, 0.0]], np.float32), (100, 1))
    assert forbidden_choices("a", choices, masks, (2,)) == ["a: 50 forbidden actions are taken"]
    assert forbidden_choices("a", np.zeros_like(choices), masks, (2,)) == []


# ------------------------------------------------------------------ archives


def test_archives_depend_on_their_arrays_alone(tmp_path: Path) -> None:
    arrays = {"b1/in/x": np.arange(6, dtype=np.float32).reshape(2, 3), "b1/out/y": np.asarray(1, np.int32)}
    for folder, content in (("one", arrays), ("two", dict(reversed(arrays.items())))):
        (tmp_path / folder).mkdir()
        write_npz(tmp_path / folder / "a.npz", content)
    assert (tmp_path / "one" / "a.npz").read_bytes() == (tmp_path / "two" / "a.npz").read_bytes()
    read = read_npz(tmp_path / "one" / "a.npz")
    assert read.keys() == arrays.keys()
    for key, value in arrays.items():
        np.testing.assert_array_equal(read[key], value, strict=True)


@pytest.mark.parametrize("name", FIXTURES)
def test_committed_archives_are_written_that_way(name: str, tmp_path: Path) -> None:
    write_npz(tmp_path / "again.npz", goldens(name))
    assert (tmp_path / "again.npz").read_bytes() == path(f"{name}.npz").read_bytes()


# ------------------------------------------------------------------ in TensorFlow


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Array]:
    archive = tmp_path_factory.mktemp("replay") / "outputs.npz"
    done = run_module("fixtures.replay", str(archive))
    assert done.returncode == 0, done.stderr
    return read_npz(archive)


@pytest.mark.runtimes
@needs_tensorflow
@pytest.mark.parametrize("name", FIXTURES)
def test_tensorflow_reproduces_the_goldens(name: str, replayed: dict[str, Array]) -> None:
    recorded = {key: value for key, value in goldens(name).items() if key.split("/", 2)[1] == "out"}
    assert recorded
    for key, value in recorded.items():
        again = replayed[f"{name}/{key}"]
        assert again.dtype == value.dtype, key
        np.testing.assert_allclose(again, value, rtol=1e-5, atol=1e-5, err_msg=key, strict=True)


@pytest.mark.runtimes
@needs_tensorflow
def test_script_makes_what_is_committed() -> None:
    installed = tensorflow_version()
    if installed != MANIFEST["tensorflow"]:
        pytest.skip(
            f"the fixtures were made by TensorFlow {MANIFEST['tensorflow']}, and {installed} may write other graphs"
        )
    done = run_module("fixtures.make_fixtures", "--check")
    assert done.returncode == 0, done.stderr


def tensorflow_version() -> str | None:
    for distribution in ("tensorflow", "tensorflow-cpu"):
        try:
            return importlib.metadata.version(distribution)
        except importlib.metadata.PackageNotFoundError:
            continue
    return None
