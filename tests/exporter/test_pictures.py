"""``inspect --logdir`` and ``--svg``: the graph for TensorBoard, the policy as a picture."""

from __future__ import annotations

import json
import struct
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.frozen_graph.encode import as_read
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.formats.tensorboard import FILE_NAME, event_file
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.exporter.export.sources import read_source
from fixtures import path as fixture
from tests.commands import ROOT, export_model, is_refused
from tests.exporting import export_model as export

SHARED = ROOT.parent / "shared"
SVG = "{http://www.w3.org/2000/svg}"


def events_in(path: Path) -> list[Any]:
    """The events that TensorFlow's own reader finds (it checks the checksums)."""
    tf = pytest.importorskip("tensorflow", reason="pip install export-model[tensorflow]")
    return [tf.compat.v1.Event.FromString(record.numpy()) for record in tf.data.TFRecordDataset(str(path))]


def graph_in(path: Path) -> Any:
    import tensorflow as tf

    first, second = events_in(path)
    assert first.file_version == "brain.Event:2"
    return tf.compat.v1.GraphDef.FromString(second.graph_def)


@pytest.mark.runtimes
@pytest.mark.parametrize("name", ["continuous", "recurrent", "twobrains", "visual"])
def test_tensorflow_reads_the_graph_back_as_it_is_in_the_file(name: str, tmp_path: Path) -> None:
    ran = export_model("inspect", fixture(name), "--logdir", tmp_path)
    assert ran.status == 0, ran.err
    path = tmp_path / name / FILE_NAME
    assert f"wrote {path}" in ran.out
    import tensorflow as tf

    source = tf.compat.v1.GraphDef.FromString(fixture(name).read_bytes())
    found = graph_in(path)
    expected = {n.name: n for n in source.node}
    assert {n.name for n in found.node} == set(expected)
    for node in found.node:
        own = expected[node.name]
        assert node.op == own.op
        assert [i.removesuffix(":0") for i in node.input] == [
            i.removesuffix(":0")
            for i in own.input
            if not i.startswith("^")  # the readers keep no control edges
        ]
        for key in own.attr:
            if key == "value":
                ours, theirs = (tf.make_ndarray(n.attr[key].tensor) for n in (node, own))
                np.testing.assert_array_equal(ours, theirs)
            elif not key.startswith("_"):
                assert node.attr[key] == own.attr[key], (node.name, key)
    with tf.Graph().as_default():
        tf.import_graph_def(found, name="")


def test_the_event_reader_of_tensorflow_takes_the_file(tmp_path: Path) -> None:
    tf = pytest.importorskip("tensorflow", reason="pip install export-model[tensorflow]")
    (tmp_path / FILE_NAME).write_bytes(event_file(read_graph(fixture("discrete").read_bytes())))
    events = list(tf.compat.v1.train.summary_iterator(str(tmp_path / FILE_NAME)))
    assert [e.WhichOneof("what") for e in events] == ["file_version", "graph_def"]


def test_tensorboard_shows_it(tmp_path: Path) -> None:
    accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator", reason="pip install tensorboard"
    )
    (tmp_path / FILE_NAME).write_bytes(event_file(read_graph(fixture("discrete").read_bytes())))
    run = accumulator.EventAccumulator(str(tmp_path))
    run.Reload()
    assert {n.name for n in run.Graph().node} >= {"state", "action_masks", "action"}


@pytest.mark.parametrize("form", ["onnx", "saved_model", "tfjs", "bytes"])
def test_every_form_of_a_bundle_has_a_graph(form: str, tmp_path: Path) -> None:
    (result,) = export(fixture("recurrent"), tmp_path, verify="none")
    given = result.folder / (form if form in ("saved_model", "tfjs") else f"recurrent.{form}")
    ran = export_model("inspect", given, "--logdir", tmp_path / "logs")
    assert ran.status == 0, ran.err
    (path,) = (tmp_path / "logs").rglob("*tfevents*")
    (model,) = read_source(given).models
    assert {n.name for n in graph_in(path).node} == {n.name for n in model.graph.nodes}


@pytest.mark.corpus
def test_a_nn_file_has_a_graph_too(tmp_path: Path) -> None:
    files = sorted((SHARED / "corpus" / "nn").rglob("*.nn")) if SHARED.is_dir() else []
    if not files:
        pytest.skip("needs ../shared: public models")
    ran = export_model("inspect", files[0], "--logdir", tmp_path, "--svg", tmp_path / "policy.svg")
    assert ran.status == 0, ran.err
    (path,) = tmp_path.rglob("*tfevents*")
    assert len(graph_in(path).node) > 5
    assert (tmp_path / "policy.svg").is_file()


def test_the_same_graph_gives_the_same_bytes() -> None:
    graph = read_graph(fixture("visual").read_bytes())
    assert event_file(graph) == event_file(graph)
    assert event_file(graph) != event_file(Graph(graph.nodes[:-1]))


ATTRIBUTE = (
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(width=32, allow_nan=False)
    | st.text(st.characters(codec="utf-8"), max_size=8)
    | st.sampled_from([np.dtype(np.float32), np.dtype(np.int64), np.dtype(np.bytes_), np.dtype(object)])
    | st.builds(TensorShape, st.none() | st.tuples(st.none() | st.integers(0, 9), st.integers(0, 9)))
    | st.lists(st.integers(-9, 9), min_size=1, max_size=4).map(tuple)
    | st.lists(st.text(st.characters(codec="utf-8"), max_size=4), min_size=1, max_size=3).map(tuple)
)


@given(st.dictionaries(st.text("abc_T", min_size=1, max_size=6).filter(lambda k: k[0] != "_"), ATTRIBUTE, max_size=5))
def test_any_attribute_comes_back(attrs: dict[str, Any]) -> None:
    graph = Graph((Node("a/b", "Anything", (), attrs),))
    data = schema.serialise(as_read(graph))
    assert read_graph(data)["a/b"].attrs == attrs


def test_records_have_their_lengths() -> None:
    data = event_file(read_graph(fixture("discrete").read_bytes()))
    sizes = []
    while data:
        (size,) = struct.unpack("<Q", data[:8])
        sizes.append(size)
        data = data[8 + 4 + size + 4 :]
    assert len(sizes) == 2


# ------------------------------------------------------------------ the picture


def test_the_picture_names_inputs_layers_and_outputs(tmp_path: Path) -> None:
    file = tmp_path / "new" / "recurrent.svg"
    ran = export_model("inspect", fixture("recurrent"), "--svg", file)
    assert ran.status == 0, ran.err
    root = ElementTree.parse(file).getroot()
    assert root.tag == f"{SVG}svg"
    assert root.get("role") == "img"
    title, desc = root.find(f"{SVG}title"), root.find(f"{SVG}desc")
    assert title is not None and desc is not None
    assert title.text == "recurrent: ML-Agents 0.7-0.16, discrete actions"
    assert "LSTM 16" in str(desc.text)
    texts = {t.text for t in root.iter(f"{SVG}text")}
    assert {"recurrent", "state · 6", "recurrent_in · 32", "LSTM 16", "action · 5"} <= texts


def test_the_picture_stands_alone_in_light_and_dark(tmp_path: Path) -> None:
    file = tmp_path / "policy.svg"
    export_model("inspect", fixture("visual"), "--svg", file)
    text = file.read_text(encoding="utf-8")
    assert "prefers-color-scheme: dark" in text
    for outside in ("href", "url(", "@import", "<script", "src="):
        assert outside not in text
    assert text.count("http") == 1  # the namespace


def test_every_box_lies_on_the_paper(tmp_path: Path) -> None:
    for name in ("continuous", "discrete", "recurrent", "visual"):
        file = tmp_path / f"{name}.svg"
        export_model("inspect", fixture(name), "--svg", file)
        root = ElementTree.parse(file).getroot()
        (group,) = (g for g in root.findall(f"{SVG}g"))
        dx, dy = map(float, str(group.get("transform")).removeprefix("translate(").rstrip(")").split())
        for rect in group.iter(f"{SVG}rect"):
            x, y, w, h = (float(str(rect.get(k))) for k in ("x", "y", "width", "height"))
            assert x + dx >= 0 and y + dy >= 0
            assert x + w + dx <= float(str(root.get("width"))) and y + h + dy <= float(str(root.get("height")))


def test_several_policies_are_several_pictures(tmp_path: Path) -> None:
    ran = export_model("inspect", fixture("twobrains"), "--svg", tmp_path / "p.svg", "--json")
    names = {"p-twobrains-Goalie-Brain-2.svg", "p-twobrains-StrikerBrain.svg"}
    assert {p.name for p in tmp_path.iterdir()} == names
    assert {Path(p).name for p in json.loads(ran.out)["written"]} == names


def test_a_place_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    is_refused(export_model("inspect", fixture("discrete"), "--svg", tmp_path / "file" / "p.svg"), "cannot be written")
    is_refused(export_model("inspect", fixture("discrete"), "--logdir", tmp_path / "file"), "cannot be written")
