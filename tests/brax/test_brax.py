"""Parameters of brax against what its own inference functions answered (fixtures/brax)."""

from __future__ import annotations

import importlib.util
import json
import os
import pickle
import shutil
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.run import run_graph
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import (
    DamagedFileError,
    ExportModelError,
    NotAPolicyError,
    RuntimeUnavailableError,
    SourceError,
    UsageError,
)
from fixtures.brax import FOLDER
from fixtures.goldens import read_npz
from tests.commands import export_model

CONFIG = "ppo_network_config.json"
NORMALISED, RAW = "brax-normalised", "brax-raw"
#: What the user says of each pickle; a folder of orbax says it itself.
SAID = {
    "ppo": ReadOptions(activation="swish", script=NORMALISED),
    "ppo_raw": ReadOptions(activation="tanh", script=RAW),
    "ppo_two": ReadOptions(activation="silu", script=NORMALISED),
    "ppo_normal": ReadOptions(activation="elu", script=NORMALISED),
    "sac": ReadOptions(activation="relu", script=NORMALISED),
    "trained": ReadOptions(activation="swish", script=NORMALISED),
    "ppo_orbax": ReadOptions(),
    "ppo_orbax_normal": ReadOptions(),
}


def source(name: str) -> Path:
    """A pickle, or a folder that orbax wrote, which needs tensorstore."""
    if (FOLDER / name).is_dir():
        pytest.importorskip("tensorstore", reason="get it with: pip install 'export-model[orbax]'")
        return FOLDER / name
    return FOLDER / f"{name}.pkl"


def test_each_file_is_tried() -> None:
    assert {p.stem for p in FOLDER.glob("*.npz")} == set(SAID)


@pytest.mark.parametrize("name", SAID)
def test_acts_as_its_own_inference_function(name: str) -> None:
    (policy,) = read_source(source(name), SAID[name]).policies()
    golden = read_npz(FOLDER / f"{name}.npz")
    (seen,) = policy.signature.observations
    answers = run_graph(policy.graph, {seen.name: golden[f"in/{seen.source}"]}, ["action"])
    assert answers["action"] == pytest.approx(golden["action"], abs=2e-6, rel=2e-5)
    assert np.abs(golden["action"]).max() > 0.05


def test_the_observation_that_the_actor_sees_is_found_by_its_width() -> None:
    """Statistics are kept of what the critic alone sees, too."""
    (policy,) = read_source(source("ppo_two"), SAID["ppo_two"]).policies()
    assert [(s.source, s.shape) for s in policy.signature.observations] == [("state", (None, 6))]


@pytest.mark.parametrize(
    "said",
    [ReadOptions(), ReadOptions(activation="swish"), ReadOptions(script=NORMALISED)],
    ids=["none", "one", "other"],
)
def test_what_a_pickle_does_not_say_is_asked_for(said: ReadOptions) -> None:
    with pytest.raises(SourceError) as error:
        read_source(source("ppo"), said)
    assert "--activation" in error.value.fix and f"--script {NORMALISED}" in error.value.fix  # type: ignore[operator]


class RunningStatisticsState:
    """What brax keeps its statistics in, by its name there."""

    def __init__(self, mean: Any, std: Any) -> None:
        self.mean, self.std = mean, std


RunningStatisticsState.__module__ = "brax.training.acme.running_statistics"


def saved(
    folder: Path, monkeypatch: pytest.MonkeyPatch, params: dict[str, Any], mean: Any = None, std: Any = None
) -> Path:
    """A pickle of these parameters, as ``model.save_params`` writes one."""
    module = types.ModuleType(RunningStatisticsState.__module__)
    module.RunningStatisticsState = RunningStatisticsState  # type: ignore[attr-defined]
    for name in ("brax", "brax.training", "brax.training.acme", module.__name__):
        monkeypatch.setitem(sys.modules, name, module)
    mean, std = np.zeros(4, np.float32) if mean is None else mean, np.ones(4, np.float32) if std is None else std
    file = folder / "params.pkl"
    file.write_bytes(pickle.dumps((RunningStatisticsState(mean, std), {"params": params})))
    return file


def dense(rows: int, columns: int) -> dict[str, np.ndarray]:
    """One layer of flax."""
    numbers = np.arange(rows * columns, dtype=np.float32).reshape(rows, columns)
    return {"kernel": np.sin(numbers), "bias": np.ones(columns, np.float32)}


def test_statistics_that_were_never_kept_leave_the_activation_alone_to_ask(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A normaliser of zeros and ones changes no number."""
    file = saved(tmp_path, monkeypatch, {"hidden_0": dense(4, 6)})
    (policy,) = read_source(file, ReadOptions(activation="relu")).policies()
    x = np.ones((1, 4), np.float32)
    answers = run_graph(policy.graph, {policy.signature.observations[0].name: x}, ["action"])
    assert answers["action"] == pytest.approx(np.tanh((x @ dense(4, 6)["kernel"] + 1)[:, :3]), abs=1e-6)


@pytest.mark.parametrize(
    ("params", "mean", "error"),
    [
        ({"hidden_0": dense(4, 5)}, None, DamagedFileError),  # means and deviations are as many
        ({"hidden_0": dense(4, 6), "CNN_0": {"Conv_0": dense(2, 2)}}, None, SourceError),
        ({"hidden_0": dense(4, 6), "other": dense(2, 2)}, None, SourceError),
        ({"hidden_0": dense(4, 6)}, {"a": np.zeros(4, np.float32), "b": np.zeros(4, np.float32)}, SourceError),
        ({"hidden_0": dense(4, 6)}, {"a": np.zeros(7, np.float32)}, SourceError),
        ({"hidden_0": dense(4, 6)}, np.zeros(5, np.float32), DamagedFileError),
    ],
    ids=["odd", "image", "unknown part", "two fit", "none fits", "other width"],
)
def test_what_is_not_read_is_refused(
    params: dict[str, Any], mean: Any, error: type, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = saved(tmp_path, monkeypatch, params, mean)
    with pytest.raises(error):
        read_source(file, ReadOptions(activation="relu", script=NORMALISED))


def test_a_configuration_beside_a_pickle_says_it(tmp_path: Path) -> None:
    shutil.copy(source("ppo"), tmp_path / "params.pkl")
    content = json.loads((FOLDER / "ppo_orbax" / CONFIG).read_text())
    (tmp_path / CONFIG).write_text(json.dumps(content))
    (policy,) = read_source(tmp_path / "params.pkl", ReadOptions()).policies()
    golden = read_npz(FOLDER / "ppo.npz")
    answers = run_graph(policy.graph, {policy.signature.observations[0].name: golden["in/obs"]}, ["action"])
    assert answers["action"] == pytest.approx(golden["action"], abs=2e-6, rel=2e-5)
    with pytest.raises(UsageError):
        read_source(tmp_path / "params.pkl", ReadOptions(activation="tanh"))


@pytest.mark.parametrize(
    ("key", "value", "error"),
    [
        (("network_factory_kwargs", "activation"), "glu", SourceError),
        (("network_factory_kwargs", "activation"), 3, SourceError),
        (("normalize_observations",), "yes", SourceError),
        (("network_factory_kwargs",), [], SourceError),
    ],
)
def test_a_configuration_that_cannot_be_meant(key: tuple[str, ...], value: Any, error: type, tmp_path: Path) -> None:
    shutil.copy(source("ppo"), tmp_path / "params.pkl")
    content = inner = json.loads((FOLDER / "ppo_orbax" / CONFIG).read_text())
    for part in key[:-1]:
        inner = inner[part]
    inner[key[-1]] = value
    (tmp_path / CONFIG).write_text(json.dumps(content))
    with pytest.raises(error) as found:
        read_source(tmp_path / "params.pkl", ReadOptions())
    assert CONFIG in str(found.value)


def test_options_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UsageError):
        read_source(source("ppo"), ReadOptions(activation="swish", script="cleanrl-ppo"))
    with pytest.raises(UsageError):
        read_source(source("ppo"), ReadOptions(activation="swosh", script=RAW))


def changed(change: bytes, into: bytes, tmp_path: Path) -> Path:
    data = (FOLDER / "ppo.pkl").read_bytes()
    assert change in data
    file = tmp_path / "params.pkl"
    file.write_bytes(data.replace(change, into))
    return file


@pytest.mark.parametrize(
    ("change", "into", "error"),
    [
        (b"hidden_0", b"hedden_0", ExportModelError),  # the first layer is missing
        (b"kernel", b"kernal", DamagedFileError),
        (b"hidden_2", b"hidden_3", ExportModelError),
    ],
)
def test_damaged_pickles_are_refused(change: bytes, into: bytes, error: type, tmp_path: Path) -> None:
    with pytest.raises(error):
        read_source(changed(change, into, tmp_path), SAID["ppo"])


def _reconstruct_array(*parts: Any) -> None:
    """What JAX pickles its arrays with."""


class ArrayOf:
    """An array of JAX around something else."""

    def __init__(self, *parts: Any) -> None:
        self.parts = parts

    def __reduce__(self) -> Any:
        return _reconstruct_array, self.parts


@pytest.mark.parametrize("parts", [(), (1, 2, 3, 4), (("a",), (), (), {}), (np.array, (), 3, None), (np.array,) * 4])
def test_an_array_around_something_else_is_damaged(
    parts: tuple[Any, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = saved(tmp_path, monkeypatch, {"hidden_0": {"kernel": ArrayOf(*parts)}})
    with pytest.raises(DamagedFileError):
        read_source(file, SAID["ppo"])


class Acts:
    """Unpickling it would run a command."""

    def __reduce__(self) -> Any:
        return os.system, ("touch acted",)


def test_nothing_of_a_pickle_is_called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file = saved(tmp_path, monkeypatch, {"hidden_0": {"kernel": Acts()}})
    with pytest.raises(NotAPolicyError):
        read_source(file, SAID["ppo"])
    assert not Path("acted").exists()


def test_without_tensorstore_a_folder_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(RuntimeUnavailableError) as error:
        read_source(FOLDER / "ppo_orbax", ReadOptions())
    assert "export-model[orbax]" in (error.value.fix or "")


@pytest.mark.parametrize("file", ["manifest.ocdbt", "_METADATA"])
def test_a_damaged_folder_is_refused(file: str, tmp_path: Path) -> None:
    folder = tmp_path / "step"
    shutil.copytree(source("ppo_orbax"), folder)
    data = bytearray((folder / file).read_bytes())
    data[len(data) // 2] ^= 0xFF
    (folder / file).write_bytes(bytes(data))
    with pytest.raises(ExportModelError):
        read_source(folder, ReadOptions())


def test_it_is_exported_and_compared(tmp_path: Path) -> None:
    command = ("--activation", "swish", "--script", NORMALISED, "--to", "onnx", "--verify", "onnxruntime")
    done = export_model(FOLDER / "trained.pkl", *command, "-o", tmp_path)
    assert done.status == 0, done.err
