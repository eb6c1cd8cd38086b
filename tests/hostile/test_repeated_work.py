"""Small files that ask for much work: each is refused by a count, before the work is done."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from converters.stable_baselines3.spaces import space_of
from exporter.export.sources import read_source
from signatures.errors import DamagedFileError

Config = dict[str, Any]


def tensor(layer: str, call: int = 0) -> Config:
    config = {"shape": [None, 2], "dtype": "float32", "keras_history": [layer, call, 0]}
    return {"class_name": "__keras_tensor__", "config": config}


def called_with(*given: Config) -> Config:
    return {"args": list(given), "kwargs": {}}


def layer(kind: str, name: str, config: Config, *calls: Config) -> Config:
    config = {"name": name, "trainable": True, "dtype": "float32", **config}
    return {"module": "keras.layers", "class_name": kind, "config": config, "name": name, "inbound_nodes": list(calls)}


def functional(name: str, layers: list[Config], output: list[Any]) -> Config:
    config = {"name": name, "layers": layers, "input_layers": ["i", 0, 0], "output_layers": output}
    return {"module": "keras", "class_name": "Functional", "config": config, "name": name, "inbound_nodes": []}


def written(model: Config, folder: Path) -> Path:
    topology = {"keras_version": "3.0", "backend": "tensorflow", "model_config": model}
    manifest = [{"paths": ["w.bin"], "weights": []}]
    content = {"format": "layers-model", "modelTopology": topology, "weightsManifest": manifest}
    folder.mkdir(parents=True)
    (folder / "model.json").write_text(json.dumps(content))
    (folder / "w.bin").touch()
    return folder


def doubling(levels: int) -> Config:
    """A model that calls a model twice, which calls a model twice …"""
    start = layer("InputLayer", "i", {"batch_shape": [None, 2]})
    model = functional("m0", [start], ["i", 0, 0])
    for level in range(1, levels + 1):
        inner = {**model, "inbound_nodes": [called_with(tensor("i")), called_with(tensor(f"m{level - 1}"))]}
        model = functional(f"m{level}", [start, inner], [f"m{level - 1}", 1, 0])
    return model


def test_models_that_call_one_another_twice(tmp_path: Path) -> None:
    assert read_source(written(doubling(3), tmp_path / "few")).policies()
    with pytest.raises(DamagedFileError, match="call one another too often"):
        read_source(written(doubling(25), tmp_path / "many")).policies()


def test_a_cropping_that_leaves_nothing(tmp_path: Path) -> None:
    start = layer("InputLayer", "i", {"batch_shape": [None, 4, 3]})
    crop = layer("Cropping1D", "c", {"cropping": [10**9, 10**9]}, called_with(tensor("i")))
    with pytest.raises(DamagedFileError, match="leaves nothing"):
        read_source(written(functional("m", [start, crop], ["c", 0, 0]), tmp_path / "m")).policies()


@pytest.mark.parametrize("text", ["\\'" * 1_000_000, "'a':Box(" * 300_000, "\\'" * 100_000, "'a':Box(" * 30_000])
def test_the_text_of_a_space(text: str) -> None:
    with pytest.raises(DamagedFileError):
        space_of({"o": {":type:": "<class 'gymnasium.spaces.dict.Dict'>", "spaces": text}}, "o")
