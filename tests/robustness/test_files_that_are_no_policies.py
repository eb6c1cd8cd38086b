"""Whatever file is given: one clear message, status 2, and nothing in the output folder."""

from __future__ import annotations

import gzip
import io
import json
import os
import pickle
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.fetch import neighbours
from export_model.converters.formats.recognise import recognise
from export_model.converters.graph.nodes import TensorShape
from export_model.signatures.errors import SourceError
from fixtures import FIXTURES
from fixtures import path as fixture
from tests.commands import export_model, files_in, is_refused
from tests.exporting import inspect_model
from tests.handmade import continuous_policy, graph_bytes, node


def zipped(*names: str) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name in names:
            archive.writestr(name, b"content")
    return stream.getvalue()


def unfrozen_saved_model() -> bytes:
    """A policy whose weights are variables."""
    nodes = [n for n in continuous_policy() if n.name != "mu/kernel"]
    message = schema.SavedModel(saved_model_schema_version=1)
    graph = message.meta_graphs.add().graph_def
    for each in (node("mu/kernel", "VariableV2", dtype=np.float32, shape=TensorShape((3, 2))), *nodes):
        graph.node.add().CopyFrom(each)
    return schema.serialise(message)


LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab2935\nsize 12345\n"
UNITY_YAML = b"%YAML 1.1\n%TAG !u! tag:unity3d.com,2011:\n--- !u!114 &11400000\nMonoBehaviour:\n  m_Name: 3DBall\n"
META_GRAPH = b"\x0a\x04\x1a\x02v1\x12\x10" + graph_bytes(continuous_policy())[:16]
SAVED_MODEL = b"\x08\x01\x12\x08\x0a\x06\x22\x05serve"
ONNX = b"\x08\x08\x12\x07pytorch\x3a\x03\x12\x01g\x42\x02\x10\x09"
NN = struct.pack("<qii", 16, 0, 3) + bytes(64)

#: name → (file name, content, kind, words that the message has)
NEVER_READ = {
    "text": ("a.bytes", b"The model is on the other disk.\n", "text", ["a text file"]),
    "text in Chinese, cut off by the first block": ("a.bytes", "x球".encode() * 2000, "text", ["a text file"]),
    "text in UTF-16": ("a.bytes", "Ball".encode("utf-16"), "unknown", ["not a model"]),
    "a web page": ("a.bytes", b"\n <!DOCTYPE html>\n<html><body>3DBall.bytes</body></html>", "html", ["a web page"]),
    "JSON": ("a.json", b'\n{"behaviors": {"3DBall": {"trainer_type": "ppo"}}}', "json", ["JSON", "'behaviors'"]),
    **{
        f"JSON, {kind}": ("a.json", json.dumps(content).encode(), kind, words)
        for kind, content, words in (
            ("keras_json", {"class_name": "Functional", "config": {}}, ["without their weights", "model.save"]),
            ("brain_js", {"type": "NeuralNetwork", "sizes": [2, 3, 1], "layers": []}, ["brain.js", "Keras or PyTorch"]),
            ("synaptic", {"neurons": [], "connections": []}, ["synaptic"]),
            ("neataptic", {"nodes": [], "connections": [], "input": 2, "output": 1, "dropout": 0}, ["neataptic"]),
            ("convnetjs", {"layers": [{"layer_type": "input", "out_sx": 1}]}, ["ConvNetJS"]),
            ("onnx_json", {"irVersion": "8", "graph": {}}, ["ONNX model as JSON", "binary"]),
            ("graph_json", {"node": [{"name": "a", "op": "Placeholder"}]}, ["graph as JSON", "binary"]),
            ("mlagents_timers", {"name": "root", "gauges": {}, "total": 1, "children": {}}, ["timers.json", "run's"]),
            ("mlagents_status", {"metadata": {"stats_format_version": "0.3.0"}}, ["training_status.json"]),
            ("hugging_face", {"architectures": ["X"], "model_type": "x"}, ["Hugging Face", "ONNX"]),
            ("notebook", {"cells": [], "nbformat": 4}, ["notebook"]),
            ("npm", {"name": "a", "version": "1", "dependencies": {}}, ["npm package"]),
            ("json", {"layers": [], "metadata": 3, "node": {}}, ["'layers', 'metadata', 'node'"]),
        )
    },
    "JSON without an end": ("a.json", b'{"a": ', "text", ["a text file"]),
    "JSON that is nested too deep": ("a.json", b'{"a":' * 100_000 + b"1" + b"}" * 100_000, "text", ["a text file"]),
    "a Git LFS pointer": ("3DBall.bytes", LFS_POINTER, "lfs_pointer", ["Git LFS pointer", "git lfs pull"]),
    "a graph as text": ("a.pbtxt", b'node {\n  name: "state"\n  op: "Placeholder"\n}\n', "text_graph", [".pbtxt"]),
    "a pickle": ("a.bytes", pickle.dumps({"a": [1.5] * 3}), "pickle", ["PyTorch did not write", "checkpoint itself"]),
    "an array in a pickle": ("a.pkl", pickle.dumps(np.zeros(3)), "pickle", ["replay buffers"]),
    "a torch checkpoint": ("a.pt", zipped("a/data.pkl", "a/data/0"), "torch_checkpoint", ["pickle"]),
    "TFLite": ("a.tflite", b"\x1c\0\0\0TFL3" + bytes(100), "litert", ["TensorFlow Lite"]),
    "a Unity asset": ("a.asset", UNITY_YAML, "unity_asset", ["a Unity asset"]),
    "an asset bundle": ("a.bytes", b"UnityFS\0\0\0\0\x08" + bytes(100), "unity_asset", ["a Unity asset"]),
    "Sentis": ("a.sentis", b"\x18\0\0\0\0\0\x12\0\xff" + bytes(100), "sentis", ["Sentis"]),
    "a picture": ("a.png", b"\x89PNG\r\n\x1a\n" + bytes(40), "png", ["a PNG picture"]),
    "an animation": ("a.bytes", b"GIF89a" + bytes(40), "gif", ["a GIF picture"]),
    "a paper": ("a.pb", b"%PDF-1.7\n" + bytes(40), "pdf", ["a PDF document"]),
    "an array": ("a.npy", b"\x93NUMPY\x01\0v\0{'descr': '<f4'}" + bytes(60), "npy", ["a NumPy array"]),
    "a tar archive": (
        "a.tar",
        b"model.onnx" + bytes(247) + b"ustar\x0000" + bytes(300),
        "tar",
        ["a tar archive", "unpack"],
    ),
    "a library": ("a.bytes", b"\x7fELF\x02\x01\x01" + bytes(60), "program", ["a program"]),
    "gzip": ("a.bytes", gzip.compress(b"a"), "gzip", ["gzip", "unpack"]),
    "zip": ("a.bytes", zipped("3DBall.bytes"), "zip", ["ZIP", "unpack"]),
    "a zip that is cut off": ("a.bytes", zipped("a.pkl")[:40], "zip", ["ZIP"]),
    "noise": ("a.bytes", b"\xff\xfe\xfd\xfc" * 100, "unknown", ["not a model"]),
}
#: name → (file name, content, kind): stubs of formats that a reader may take, too little to be read
STUBS = {
    "a .nn under another name": ("a.bytes", NN, "nn"),
    "ONNX under another name": ("a.bytes", ONNX, "onnx"),
    "the file of a SavedModel": ("saved_model.pb", SAVED_MODEL, "saved_model"),
    "a MetaGraph": ("model-1.cptk.meta", META_GRAPH, "meta_graph"),
    "a checkpoint's index": ("model-1.cptk.index", bytes(40) + struct.pack("<Q", 0xDB4775248B80FB57), "checkpoint"),
    "a checkpoint's list": ("checkpoint", b'model_checkpoint_path: "model-1.cptk"\n', "checkpoint"),
    "a checkpoint's data": ("m.data-00000-of-00001", b"\xff\xfe\xfd\xfc" * 100, "checkpoint"),
    "a Keras model": ("a.keras", zipped("metadata.json", "config.json", "model.weights.h5"), "keras"),
    "HDF5": ("a.h5", b"\x89HDF\r\n\x1a\n" + bytes(100), "hdf5"),
    "a TensorFlow.js model": ("model.json", b'{"modelTopology": {}, "weightsManifest": []}', "tfjs"),
}


@pytest.mark.parametrize("what", NEVER_READ)
def test_a_file_that_is_something_else_is_named_for_what_it_is(what: str, tmp_path: Path) -> None:
    name, content, kind, words = NEVER_READ[what]
    (tmp_path / name).write_bytes(content)
    assert recognise(content, name).key == kind
    message = is_refused(export_model(tmp_path / name, "-o", tmp_path / "out"), tmp_path / name, *words)
    assert "\n  fix: " in message
    assert files_in(tmp_path) == {name}


#: The ones that TensorFlow is asked to freeze, in a process of its own.
FROZEN_FIRST = ("a Keras model", "HDF5")


@pytest.mark.parametrize(
    "what", [pytest.param(what, marks=[pytest.mark.slow] if what in FROZEN_FIRST else []) for what in STUBS]
)
def test_too_little_of_another_format_is_refused(what: str, tmp_path: Path) -> None:
    name, content, kind = STUBS[what]
    (tmp_path / name).write_bytes(content)
    assert recognise(content, name).key == kind
    is_refused(export_model(tmp_path / name, "-o", tmp_path / "out"), tmp_path / name)
    assert files_in(tmp_path) == {name}


def test_pickles_beside_a_checkpoint_are_passed_over(tmp_path: Path) -> None:
    """Settings and buffers of a run are not models, and do not spoil the export of its folder."""
    run = tmp_path / "run"
    run.mkdir()
    (run / "policy.bytes").write_bytes(graph_bytes(continuous_policy()))
    for name in ("args.pkl", "vecnormalize.pkl", "buffer.pickle"):
        (run / name).write_bytes(pickle.dumps({name: np.zeros(3), "of": Path()}))
    ran = export_model(run, "-o", tmp_path / "out", "--verify", "none")
    assert ran.status == 0, ran.err
    assert "pkl" not in ran.err + ran.out


def test_what_this_tool_writes_is_recognised_by_its_content(tmp_path: Path) -> None:
    assert export_model(fixture("continuous"), "-o", tmp_path, "--verify", "none").status == 0
    bundle = tmp_path / "continuous"
    kinds = {
        "continuous.bytes": "bytes",
        "saved_model/saved_model.pb": "saved_model",
        "tfjs/model.json": "tfjs",
        "continuous.onnx": "onnx",
        "policy.json": "json",
    }
    assert {path: recognise((bundle / path).read_bytes(), "misleading.txt").key for path in kinds} == kinds


def test_a_kind_that_is_not_read_says_what_to_do_instead(tmp_path: Path) -> None:
    (tmp_path / "a.bytes").write_bytes(LFS_POINTER)
    ran = export_model(tmp_path / "a.bytes", "-o", tmp_path / "out", "--json")
    assert ran.status == 2
    assert ran.json["error"] == "NotAPolicyError"
    assert ran.json["where"] == str(tmp_path / "a.bytes")
    assert "git lfs pull" in ran.json["fix"]


# ------------------------------------------------------------------ paths


def test_a_missing_file_names_the_one_that_was_probably_meant(tmp_path: Path) -> None:
    (tmp_path / "3DBall.bytes").write_bytes(b"x")
    is_refused(export_model(tmp_path / "3DBal.bytes"), "no such file", f"did you mean {tmp_path / '3DBall.bytes'}?")
    is_refused(export_model(tmp_path / "Walker.onnx"), "no such file", "check the path")
    is_refused(export_model(tmp_path / "nowhere" / "3DBall.bytes"), "no such file", "check the path")


@pytest.mark.parametrize(
    ("there", "missing", "is_meant"),
    [
        ("h.html", "x.toml", False),
        ("b.toml", "a.toml", False),
        ("labels.html", "labels.toml", False),
        ("3DBall.html", "3DBall.onnx", False),
        ("labels.toml", "label.toml", True),
        ("3DBall.onnx", "3DBall.onx", True),
        ("3DBall.onnx", "3DBall", True),
    ],
)
def test_what_is_suggested_is_near_in_name_and_of_the_same_kind(
    there: str, missing: str, is_meant: bool, tmp_path: Path
) -> None:
    (tmp_path / there).touch()
    said = neighbours(tmp_path / missing)
    assert said == (f"did you mean {tmp_path / there}?" if is_meant else "check the path")


def test_an_address_is_no_path() -> None:
    """tests/remote has those that are fetched."""
    ran = export_model("ftp://example.com/models/3DBall.onnx")
    is_refused(ran, "ftp://example.com/models/3DBall.onnx: is an address", "download it")


def test_a_saved_model_without_its_variables_is_told_to_bring_its_folder(tmp_path: Path) -> None:
    (tmp_path / "saved_model.pb").write_bytes(unfrozen_saved_model())
    for given in (tmp_path, tmp_path / "saved_model.pb"):
        is_refused(export_model(given, "--verify", "none", "-o", tmp_path / "out"), "variables/", "the whole folder")


def test_a_frozen_graph_that_is_called_saved_model_is_one(tmp_path: Path) -> None:
    folder = tmp_path / "3DBall"
    folder.mkdir()
    (folder / "saved_model.pb").write_bytes(fixture("continuous").read_bytes())
    ran = export_model(folder, "--verify", "none", "-o", tmp_path / "out")
    assert ran.status == 0, ran.err
    assert (tmp_path / "out" / "3DBall" / "policy.json").is_file()


def test_a_folder_without_a_model_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "events.txt").write_text("nothing")
    is_refused(export_model(tmp_path / "run", "-o", tmp_path / "out"), tmp_path / "run")
    assert files_in(tmp_path) == {"run", "run/events.txt"}


def test_an_empty_file_is_called_empty(tmp_path: Path) -> None:
    (tmp_path / "a.bytes").touch()
    is_refused(export_model(tmp_path / "a.bytes", "-o", tmp_path / "out"), tmp_path / "a.bytes", "empty")
    assert files_in(tmp_path) == {"a.bytes"}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes here")
def test_a_pipe_is_refused_without_waiting_for_it(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.bytes")
    is_refused(export_model(tmp_path / "a.bytes"), tmp_path / "a.bytes", "a pipe or a device")


def test_a_file_beyond_two_gigabytes_is_refused_without_reading_it(tmp_path: Path) -> None:
    with (tmp_path / "a.bytes").open("wb") as stream:
        stream.truncate(3 << 30)  # sparse: it takes no room
    is_refused(export_model(tmp_path / "a.bytes"), "3221225472 bytes", "no more than 2147483647 are read")


def test_a_path_that_cannot_be_one_is_refused(tmp_path: Path) -> None:
    is_refused(export_model(tmp_path / ("x" * 5000)), "cannot be read")
    with pytest.raises(SourceError, match="cannot be a path"):  # no command line can say this, but a program can
        inspect_model("a\0b.bytes")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    is_refused(export_model(tmp_path / "loop"), tmp_path / "loop", "cannot be read")


# ------------------------------------------------------------------ cut off


@pytest.mark.parametrize("percent", range(10, 100, 10))
@pytest.mark.parametrize("name", FIXTURES)
def test_a_graph_that_is_cut_off_is_refused(name: str, percent: int, tmp_path: Path) -> None:
    data = fixture(name).read_bytes()
    (tmp_path / "cut.bytes").write_bytes(data[: len(data) * percent // 100])
    is_refused(export_model(tmp_path / "cut.bytes", "-o", tmp_path / "out", "--verify", "none"), tmp_path / "cut.bytes")
    assert files_in(tmp_path) == {"cut.bytes"}


def test_a_graph_that_went_through_a_text_filter_is_refused(tmp_path: Path) -> None:
    data = fixture("continuous").read_bytes()
    (tmp_path / "crlf.bytes").write_bytes(data.replace(b"\n", b"\r\n"))
    is_refused(export_model(tmp_path / "crlf.bytes"), tmp_path / "crlf.bytes")


def test_the_error_as_json_has_the_message_in_parts(tmp_path: Path) -> None:
    ran = export_model(tmp_path / "a.bytes", "--json")
    assert json.loads(ran.out) == {
        "error": "SourceError",
        "what": "no such file",
        "where": str(tmp_path / "a.bytes"),
        "why": None,
        "fix": "check the path",
        "exit_status": 2,
    }
    assert ran.err == f"error: {tmp_path / 'a.bytes'}: no such file\n  fix: check the path\n"
