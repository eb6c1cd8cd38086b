"""Pipes, sockets, devices, holes, folders and circles of links in place of each file that a model is made of."""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import onnx
import pytest

from export_model.converters.files import fetch
from export_model.converters.files.fetch import Fetched, read_bytes
from export_model.converters.formats.checkpoint.tensor_bundle import Checkpoint
from export_model.signatures.errors import SourceError
from tests.checkpoint.writing import bundle as write_checkpoint
from tests.checkpoint.writing import policy as training_policy
from tests.commands import Ran, export_model
from tests.fuzz.seeds import Files, _seeds
from tests.hostile import zoo
from tests.hostile.test_places import device, fifo, folder, hole, itself

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="they are POSIX's"),
    pytest.mark.timeout(60),  # what waits for a pipe fails, and does not hold the others up
]
#: Seconds of computing, and bytes of memory, that a refusal may take.
SECONDS, MEMORY = 5.0, 256 << 20


def local_socket(path: Path) -> None:
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as made:  # its address may have 100 signs
        made.bind(path.name)


def circle(path: Path) -> None:
    """Two links that lead to each other."""
    other = path.with_name("other")
    other.symlink_to(path.name)
    path.symlink_to(other.name)


def small_hole(path: Path) -> None:
    """Less than any limit of size, and yet nothing that was ever written."""
    with path.open("wb") as file:
        file.write(b"\x80")
        file.truncate(1 << 30)


ODD = (fifo, local_socket, device, hole, small_hole, itself, circle, folder)


def written(files: Files, place: Path) -> None:
    for name, data in files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_bytes(data)


def seed(reader: str, with_file: str = "") -> Files:
    """The first seed of the fuzz tests that has such a file."""
    return next(f for f in _seeds(reader) if any(n.endswith(with_file) for n in f))


def external(place: Path) -> None:
    onnx.save_model(
        onnx.ModelProto.FromString(zoo.onnx_policy()),
        place / "policy.onnx",
        save_as_external_data=True,
        location="policy.data",
        size_threshold=0,
    )


def checkpoint(shards: int) -> Callable[[Path], None]:
    """A run's checkpoint; of two shards the second holds nothing that the policy needs."""

    def make(place: Path) -> None:
        graph = training_policy()
        write_checkpoint(place / "model-10.cptk", graph.variables, shards=1)
        graph.write(place / "raw_graph_def.pb", meta=False)
        if shards == 2:
            unused(place / "model-10.cptk")

    return make


def unused(prefix: Path) -> None:
    """One more shard in the index than holds anything."""
    graph = training_policy()
    for left in prefix.parent.glob(f"{prefix.name}.*"):
        left.unlink()
    values = dict(sorted(graph.variables.items()))
    first = next(iter(values))
    write_checkpoint(prefix, {**values, f"{first}_not_needed": np.zeros(3, np.float32)}, shards=len(values) + 1)


def saved_model(place: Path) -> None:
    graph = training_policy()
    zoo.saved(place, graph.message, "action:0", lambda meta: None)
    write_checkpoint(place / "saved/variables/variables", graph.variables)


#: Without its contract a bundle is a folder of models, the first of which is taken.
BESIDE = "bundle: its contract"
#: What is made, what is given of it, and the file that is replaced.
CASES: dict[str, tuple[Callable[[Path], None], str, str]] = {
    "ONNX: the model": (external, "policy.onnx", "policy.onnx"),
    "ONNX: its weights": (external, "policy.onnx", "policy.data"),
    "checkpoint: its index": (checkpoint(1), "", "model-10.cptk.index"),
    "checkpoint: its values": (checkpoint(1), "", "model-10.cptk.data-00000-of-00001"),
    "checkpoint: its graph": (checkpoint(1), "", "raw_graph_def.pb"),
    "SavedModel: the model": (saved_model, "saved", "saved/saved_model.pb"),
    "SavedModel: the index of its values": (saved_model, "saved", "saved/variables/variables.index"),
    "SavedModel: its values": (saved_model, "saved", "saved/variables/variables.data-00000-of-00001"),
    "TensorFlow.js: the model": (lambda p: written(seed("TensorFlow.js"), p), "", "model.json"),
    "TensorFlow.js: its weights": (lambda p: written(seed("TensorFlow.js"), p), "", "group1-shard1of1.bin"),
    "layers model: its weights": (lambda p: written(seed("layers model"), p), "", "*.bin"),
    "PyTorch": (lambda p: written(seed("PyTorch"), p), "policy.pt", "policy.pt"),
    "PyTorch's other name": (lambda p: written({"p.pth": seed("PyTorch")["policy.pt"]}, p), "p.pth", "p.pth"),
    "Stable-Baselines3": (lambda p: written(seed("Stable-Baselines3"), p), "policy.zip", "policy.zip"),
    "Keras": (lambda p: (p / "m.keras").write_bytes(b""), "m.keras", "m.keras"),
    "HDF5": (lambda p: (p / "m.h5").write_bytes(b""), "m.h5", "m.h5"),
    "Barracuda": (lambda p: (p / "m.nn").write_bytes(b""), "m.nn", "m.nn"),
    "frozen graph": (lambda p: (p / "m.bytes").write_bytes(b""), "m.bytes", "m.bytes"),
    BESIDE: (lambda p: written(seed("bundle"), p), "", "policy.json"),
    "bundle: its graph": (lambda p: written(seed("bundle"), p), "", "*.bytes"),
}


def commands(given: Path, out: Path) -> Iterator[tuple[object, ...]]:
    yield "inspect", given
    yield given, "-o", out, "--to", "bytes", "--verify", "none"
    yield "compare", given, given, "--runtimes", "numpy"


def refused(ran: Ran, status: int = 2) -> None:
    assert ran.status == status, (ran.status, ran.out, ran.err)
    assert "Traceback" not in ran.err + ran.out
    assert "did not expect" not in ran.err + ran.out


@pytest.mark.parametrize("make", ODD)
@pytest.mark.parametrize("name", CASES)
def test_it_is_refused_at_once(name: str, make: Callable[[Path], None], tmp_path: Path) -> None:
    build, given, replaced = CASES[name]
    place = tmp_path / "given"
    place.mkdir()
    build(place)
    (target,) = place.glob(replaced)
    target.unlink()
    make(target)
    # A policy.json that is no file is none: what is beside it is read, and compared in no runtime but our own.
    expected = (0, 0, 3) if name == BESIDE and make not in (hole, small_hole) else (2, 2, 2)
    for command, status in zip(commands(place / given, tmp_path / "out"), expected, strict=True):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        begun = time.process_time()
        ran = export_model(*command)
        assert time.process_time() - begun < SECONDS
        refused(ran, status)
        assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) << 10 < MEMORY
        assert name == BESIDE or not (tmp_path / "out").exists()


@pytest.mark.parametrize("make", ODD)
def test_a_shard_that_nothing_is_read_from_is_not_read_to_its_end(make: Callable[[Path], None], tmp_path: Path) -> None:
    """Its bytes are part of the source's hash."""
    place = tmp_path / "given"
    place.mkdir()
    checkpoint(2)(place)
    held = Checkpoint(place / "model-10.cptk")
    (name,) = (n for n in held.names if n.endswith("_not_needed"))
    target = held._shard(held._entry(name.encode(), name).shard_id)
    good = tmp_path / "good"
    shutil.copytree(place, good)
    assert export_model(good, "-o", tmp_path / "fine", "--to", "bytes", "--verify", "none").status == 0
    target.unlink()
    make(target)
    for command in commands(place, tmp_path / "out"):
        begun = time.process_time()
        refused(export_model(*command))
        assert time.process_time() - begun < SECONDS


def test_a_file_with_some_holes_is_read(tmp_path: Path) -> None:
    """As a copy of weights with zeros among them may have."""
    path = tmp_path / "weights"
    with path.open("wb") as file:
        file.write(b"\1" * (20 << 20))
        file.seek(10 << 20, os.SEEK_CUR)
        file.write(b"\1")
    assert len(read_bytes(path)) == (30 << 20) + 1


@pytest.mark.parametrize(("size", "is_read"), [(200 << 20, True), (256 << 20, False)])
def test_a_file_of_zeros_is_read_where_that_costs_nothing(size: int, is_read: bool, tmp_path: Path) -> None:
    """ZFS and cp --sparse=always keep zeros that were written as holes."""
    path = tmp_path / "weights"
    with path.open("wb") as file:
        file.write(b"\1")
        file.truncate(size)
    if is_read:
        assert len(read_bytes(path)) == size
        return
    with pytest.raises(SourceError, match="never written") as caught:
        read_bytes(path)
    assert "cp --sparse=never" in str(caught.value.fix)
    copy = tmp_path / "copy"
    subprocess.run(["cp", "--sparse=never", path, copy], check=True)
    assert len(read_bytes(copy)) == size


def test_files_that_are_only_hashed_are_bounded_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetch, "MAX_WEIGHTS", 1 << 20)
    for name in "abc":
        (tmp_path / name).write_bytes(bytes(1 << 19))
    files = sorted(tmp_path.iterdir())
    Fetched(tmp_path).digest(files[:2])
    with pytest.raises(SourceError, match="no more than 0 are read"):
        Fetched(tmp_path).digest(files)
