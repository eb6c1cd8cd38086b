"""Checkpoints of runs that ended: numpy's scalars beside the weights are data, and the policy acts as its trainer's."""

from __future__ import annotations

import io
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.files.unpickle import unpickle
from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.run import run_graph
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import DamagedFileError, NotAPolicyError
from fixtures.finished import FOLDER
from fixtures.goldens import read_npz
from tests.torch_checkpoint.pt_files import Writer, scalar

NAMES = sorted(path.stem for path in FOLDER.glob("*.npz"))
DTYPES = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "?", ">f8", ">i4")


def placed(name: str, folder: Path) -> Path:
    """The checkpoint and the settings of its run."""
    if name == "rllib":
        for file, short in (("class_and_ctor_args", "arguments"), ("module_state", "state")):
            shutil.copy(FOLDER / f"rllib.{short}.pkl", folder / f"{file}.pkl")
        return folder
    if (settings := FOLDER / f"{name}.yaml").exists():
        shutil.copy(settings, folder / "agent.yaml")
    (checkpoint,) = (path for path in FOLDER.glob(f"{name}.*") if path.suffix in (".pt", ".pth", ".zip"))
    return Path(shutil.copy(checkpoint, folder))


@pytest.mark.parametrize("name", NAMES)
def test_a_run_that_ended_is_read_and_acts_as_its_trainer(name: str, tmp_path: Path) -> None:
    path = placed(name, tmp_path)
    told = ReadOptions(activation="elu") if name == "rsl_rl" else ReadOptions()
    (policy,) = read_source(path, told).policies()
    golden = read_npz(FOLDER / f"{name}.npz")
    feeds = {
        s.name: golden["in/obs"] if s.shape[-1] == 4 else np.zeros((3, 2), np.float32) for s in policy.signature.inputs
    }
    outputs = [s.name for s in policy.signature.outputs]
    output = "deterministic_action" if "deterministic_action" in outputs else "action"
    assert run_graph(policy.graph, feeds, [output])[output] == pytest.approx(golden["action"], abs=2e-6)


def _data(value: Any, protocol: int) -> Any:
    return unpickle(io.BytesIO(pickle.dumps(value, protocol=protocol)), lambda _: None)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_scalars_of_plain_dtypes_are_numbers(protocol: int) -> None:
    values = {dtype: np.array(100.0 if dtype != "?" else 1).astype(dtype)[()] for dtype in DTYPES}
    read = _data({"best": list(values.values())}, protocol)["best"]
    assert read == [value.item() for value in values.values()]
    assert [type(v) for v in read] == [type(v.item()) for v in values.values()]
    for other in (np.datetime64("2026-01-01"), np.complex64(1), np.void(b"abcd"), np.str_("best")):
        with pytest.raises(NotAPolicyError, match="its pickle asks for numpy"):
            _data({"best": other}, protocol)
    with pytest.raises(NotAPolicyError, match="its pickle asks for numpy"):  # an array may be a normaliser's
        _data({"mean": np.zeros(3)}, protocol)


def test_a_scalar_that_lacks_bytes_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    path.write_bytes(Writer().zip({"best": scalar("f8", b"\0\0\0\0")}))
    with pytest.raises(DamagedFileError, match="the bytes of its dtype"):
        read_source(path)
