"""HDF5 files that reach elsewhere, or claim more than they hold: refused before anything of it is read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.keras.source import read
from export_model.converters.formats.source import ReadOptions
from export_model.signatures.errors import DamagedFileError, NotAPolicyError, SourceError

h5py = pytest.importorskip("h5py")

LAYERS: list[dict[str, Any]] = [
    {"class_name": "InputLayer", "config": {"name": "state", "batch_input_shape": [None, 3], "dtype": "float32"}},
    {"class_name": "Dense", "config": {"name": "action", "units": 2, "use_bias": False}},
]


def written(path: Path, kernel: Any, config: Any = None) -> Path:
    """An ``.h5`` of one Dense layer; ``kernel`` puts it into the layer's group."""
    config = {"class_name": "Sequential", "config": {"name": "m", "layers": LAYERS}} if config is None else config
    with h5py.File(path, "w") as file:
        file.attrs["model_config"] = json.dumps(config)
        root = file.create_group("model_weights")
        root.attrs["layer_names"] = np.array([b"action"])
        group = root.create_group("action")
        group.attrs["weight_names"] = np.array([b"kernel:0"])
        kernel(group)
    return path


def plain(group: Any) -> None:
    group["kernel:0"] = np.ones((3, 2), np.float32)


def bomb(group: Any) -> None:
    group.create_dataset("kernel:0", (1 << 20, 1 << 10), np.float32, chunks=(1 << 10, 1 << 10), compression="gzip")


def unwritten(group: Any) -> None:
    group.create_dataset("kernel:0", (1 << 20, 1 << 20), np.float32)


def outside(group: Any) -> None:
    group["kernel:0"] = h5py.ExternalLink("/etc/passwd", "/kernel")


def external_storage(group: Any) -> None:
    group.create_dataset("kernel:0", (3, 2), np.float32, external=[("/etc/passwd", 0, 24)])


def virtual(group: Any) -> None:
    layout = h5py.VirtualLayout((3, 2), np.float32)
    layout[:] = h5py.VirtualSource("/etc/passwd", "kernel", (3, 2))
    group.create_virtual_dataset("kernel:0", layout)


def soft(group: Any) -> None:
    group["kernel:0"] = h5py.SoftLink("/model_weights/action")


def references(group: Any) -> None:
    group["kernel:0"] = np.array([group.ref] * 6, h5py.ref_dtype)


def text(group: Any) -> None:
    group["kernel:0"] = np.array([b"x"] * 6)


def test_the_plain_file_is_read(tmp_path: Path) -> None:
    (model,) = read(Fetched(written(tmp_path / "m.h5", plain)), ReadOptions())
    assert [*model.facts.outputs] == ["action"]


@pytest.mark.parametrize(
    "kernel", [bomb, unwritten, outside, external_storage, virtual, soft, references, text], ids=lambda f: f.__name__
)
def test_what_is_no_array_in_the_file_is_refused(tmp_path: Path, kernel: Any) -> None:
    with pytest.raises(DamagedFileError, match="its weights cannot be read"):
        read(Fetched(written(tmp_path / "m.h5", kernel)), ReadOptions())


@pytest.mark.parametrize(
    "change",
    [
        {"units": -2},
        {"units": None},
        {"activation": {"class_name": "Dense", "config": {}}},
        {"name": "other"},
        {"use_bias": True},
        {"units": 1 << 62},
    ],
    ids=str,
)
def test_settings_that_do_not_fit_are_refused(tmp_path: Path, change: dict[str, Any]) -> None:
    dense = {"class_name": "Dense", "config": {**LAYERS[1]["config"], **change}}
    config = {"class_name": "Sequential", "config": {"name": "m", "layers": [LAYERS[0], dense]}}
    with pytest.raises((DamagedFileError, NotAPolicyError)):
        read(Fetched(written(tmp_path / "m.h5", plain, config)), ReadOptions())


@pytest.mark.parametrize("dtype", ["f4,f4", f"{'9' * 5000}f4,f4", "object", "string", "M8[s]"], ids=lambda d: d[-9:])
def test_an_input_is_of_numbers(tmp_path: Path, dtype: str) -> None:
    """numpy reads a dtype with commas as Python, and raised SyntaxError at 5000 digits."""
    layers = [{**LAYERS[0], "config": {**LAYERS[0]["config"], "dtype": dtype}}, LAYERS[1]]
    path = written(tmp_path / "m.h5", plain, {"class_name": "Sequential", "config": {"name": "m", "layers": layers}})
    with pytest.raises(NotAPolicyError, match="the input 'state' has the dtype '") as refused:
        read(Fetched(path), ReadOptions())
    assert len(str(refused.value)) < 500


@pytest.mark.parametrize(
    ("names", "said", "error"),
    [
        (("observations", "actions", "rewards", "terminals", "infos/qpos"), "is a data set", NotAPolicyError),
        (("data/demo_0/actions",), "is a data set", NotAPolicyError),
        (("episode_0/observations",), "is a data set", NotAPolicyError),
        (("layers/dense/vars/0", "vars"), "weights alone, or something else: layers, metadata, vars", DamagedFileError),
        (("grid",), "something else: grid", DamagedFileError),
        ((), "or nothing", DamagedFileError),
    ],
)
def test_a_file_that_is_no_model_is_called_what_it_is(
    names: tuple[str, ...], said: str, error: type[SourceError], tmp_path: Path
) -> None:
    """A text beside the arrays, which a data set has, too, is not looked at."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in names:
            file[name] = np.zeros((3, 2), np.float32)
        if names:
            file["metadata/algorithm"] = "SAC"
    with pytest.raises(error, match=said):
        read(Fetched(tmp_path / "a.h5"), ReadOptions())
