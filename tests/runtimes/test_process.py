"""The Node process: its frames, its streams, its ends."""

from __future__ import annotations

import io
import shutil
import struct
import subprocess
from pathlib import Path

import ml_dtypes
import numpy as np
import pytest

from export_model.converters.files.children.frames import write_frame
from tests.runtimes.graph_models import (
    batch,
    info,
    node,
    placeholder,
    twins,
    twins_by_numpy,
    write_model,
)
from tests.runtimes.pipe import HOME, NEEDS_NODE, NODE, RUNNER, Runner, frame

pytestmark = NEEDS_NODE


@pytest.mark.parametrize("runtime", ["tfjs-cpu", "tfjs-wasm"])
def test_the_end_of_stdin_ends_the_process(tmp_path: Path, runtime: str) -> None:
    runner = Runner(runtime)
    runner.load(twins(tmp_path))
    runner.run(batch(1))
    assert runner.end()[:2] == (0, b"")


def test_the_end_of_stdin_ends_a_process_that_was_never_asked(own: Runner) -> None:
    assert own.end() == (0, b"", "")


def test_requests_may_be_sent_ahead_and_in_pieces(own: Runner, tmp_path: Path) -> None:
    folder = twins(tmp_path)
    feeds = [batch(3, seed) for seed in range(5)]
    data = frame({"cmd": "load", "id": "m", "path": str(folder)})
    data += b"".join(frame({"cmd": "run", "id": "m"}, each) for each in feeds)
    for start in range(0, len(data), 11):
        own.send(data[start : start + 11])
    assert own.receive()[0]["ok"]
    for each in feeds:
        _, got = own.receive()
        np.testing.assert_allclose(got["action"], twins_by_numpy(**each)["action"], rtol=1e-5, atol=1e-5)
    assert own.end()[:2] == (0, b"")


def test_several_runs_are_one_request(own: Runner, tmp_path: Path) -> None:
    own.load(twins(tmp_path))
    feeds = [batch(3, seed) for seed in range(3)]
    sent = {f"{i}.{name}": array for i, each in enumerate(feeds) for name, array in each.items()}
    runs = [{"feeds": {name: f"{i}.{name}" for name in each}} for i, each in enumerate(feeds)]
    header, got = own.ask("runs", sent, id="m", runs=[*runs, {**runs[0], "fetch": ["value"]}])
    assert header["ok"], header
    for i, each in enumerate(feeds):
        np.testing.assert_allclose(got[f"{i}/action"], twins_by_numpy(**each)["action"], rtol=1e-5, atol=1e-5)
    assert [name for name in got if name.startswith("3/")] == ["3/value"]
    np.testing.assert_array_equal(got["3/value"], got["0/value"])
    assert "nothing" in own.error("runs", sent, id="m", runs=[runs[0], {**runs[1], "fetch": ["nothing"]}])


def test_a_large_tensor_goes_there_and_back(own: Runner, tmp_path: Path) -> None:
    nodes = [placeholder("x", "float32", [None]), node("y", "Identity", "x", T={"type": "DT_FLOAT"})]
    signature = ({"x": info("x:0", "float32", [None])}, {"y": info("y:0", "float32", [None])})
    own.load(write_model(tmp_path, nodes, {}, *signature))
    values = np.random.default_rng(0).standard_normal(3_000_001).astype(np.float32)
    np.testing.assert_array_equal(own.run({"x": values})["y"], values)


def test_a_frame_that_is_cut_off_ends_the_process_with_status_1(own: Runner) -> None:
    own.send(frame({"cmd": "run", "id": "m"}, batch(2))[:-5])
    status, out, err = own.end()
    assert status == 1
    assert "stdin ended within a frame" in err
    assert b"stdin ended" in out


@pytest.mark.parametrize(
    "data",
    [
        struct.pack("<I", 2**31),
        frame({"cmd": "run", "tensors": [{"name": "x", "dtype": "object", "shape": [1]}]}),
        frame({"cmd": "run", "tensors": [{"name": "x", "dtype": "float32", "shape": [-1]}]}),
        frame({"cmd": "run", "tensors": [{"name": "x", "dtype": "float32", "shape": [2**40, 2**40]}]}),
        frame({"cmd": "run", "tensors": [None]}),
        frame({"cmd": "run", "tensors": 1}),
    ],
    ids=["length", "dtype", "shape", "size", "spec", "list"],
)
def test_frames_that_cannot_be_followed_end_it_after_a_last_answer(own: Runner, data: bytes) -> None:
    own.send(data)
    header, _ = own.receive()
    assert header["ok"] is False
    assert header["error"].startswith("lost: ")
    status, out, err = own.end()
    assert (status, out) == (1, b"")
    assert err.startswith("runner.mjs: ")


def test_what_packages_print_goes_to_stderr(own: Runner, tmp_path: Path) -> None:
    nodes = [
        placeholder("x", "float32", [None]),
        node("y", "Print", "x", "x", T={"type": "DT_FLOAT"}, message={"s": "c2hvdXQ="}, summarize={"i": "3"}),
    ]
    signature = ({"x": info("x:0", "float32", [None])}, {"y": info("y:0", "float32", [None])})
    own.load(write_model(tmp_path, nodes, {}, *signature))
    assert own.run({"x": np.array([5, 6], np.float32)})["y"].tolist() == [5, 6]
    status, out, err = own.end()
    assert (status, out) == (0, b"")
    assert "shout" in err


def test_the_packages_are_found_from_the_folder_that_is_named(tmp_path: Path) -> None:
    """In an installed package runner.mjs and its modules lie in site-packages, with no node_modules near."""
    for module in RUNNER.parent.glob("*.mjs"):
        shutil.copy(module, tmp_path)
    script = tmp_path / "runner.mjs"
    runner = Runner("tfjs-wasm", script=script)
    runner.load(twins(tmp_path / "model"))
    assert runner.run(batch(1)).keys() == {"value", "action"}
    assert runner.end()[0] == 0


def test_missing_packages_are_an_answer(tmp_path: Path) -> None:
    runner = Runner(modules=tmp_path)
    assert runner.error("hello") == runner.error("hello") == "Cannot find module '@tensorflow/tfjs-core'"
    assert runner.end()[:2] == (0, b"")


@pytest.mark.parametrize(
    "arguments",
    [[], ["--runtime", "tfjs-cpu"], ["--runtime", "tfjs-gpu", "--modules", "."], ["--speed", "9"], ["extra"]],
)
def test_a_bad_command_line_is_status_2(arguments: list[str]) -> None:
    assert NODE is not None
    done = subprocess.run([NODE, str(RUNNER), *arguments], input=b"", capture_output=True, timeout=300)
    assert (done.returncode, done.stdout) == (2, b"")
    message = done.stderr.decode()
    assert message.startswith("runner.mjs: ")
    assert message.count("\n") == 1


def test_only_the_packages_that_are_needed_are_loaded(tmp_path: Path) -> None:
    """A home with the four packages and their small dependencies is enough; tfjs itself, with layers and webgl, is not.

    The runner is started with a link farm for a home, so that anything else would not be found.
    """
    modules = tmp_path / "node_modules"
    (modules / "@tensorflow").mkdir(parents=True)
    for entry in (HOME / "node_modules").iterdir():
        if entry.name != "@tensorflow" and not entry.name.startswith("."):
            (modules / entry.name).symlink_to(entry)
    for name in ("tfjs-core", "tfjs-converter", "tfjs-backend-cpu"):
        shutil.copytree(HOME / "node_modules" / "@tensorflow" / name, modules / "@tensorflow" / name, ignore=_only_node)
    runner = Runner(modules=tmp_path)
    assert runner.ask("hello")[0]["ok"]
    assert runner.end()[0] == 0


def _only_node(folder: str, names: list[str]) -> list[str]:
    """For copytree: leaves out all but what Node loads (the packages are 80 MB)."""
    if Path(folder).name == "dist":
        return [name for name in names if not name.endswith(".node.js")]
    return [name for name in names if name not in ("dist", "package.json")]


@pytest.mark.parametrize("dtype", ["float16", ">f4", "M8[s]", "bfloat16"])
def test_a_frame_is_whole_whatever_its_tensors_are(dtype: str) -> None:
    """What numpy shows to no stream is sent as bytes: half a frame would be read on with the next one's."""
    kind = np.dtype(ml_dtypes.bfloat16 if dtype == "bfloat16" else dtype)
    stream = io.BytesIO()
    write_frame(stream, {"ok": True}, {"x": np.zeros((2, 3), kind), "none": np.zeros(0, kind)})
    size = stream.tell()
    (length,) = struct.unpack("<I", stream.getvalue()[:4])
    assert size == 4 + length + 6 * kind.itemsize
