"""What an artefact calls its inputs and outputs, read from the file of whichever tool."""

from __future__ import annotations

import json
from pathlib import Path

import onnx
import pytest
from onnx import TensorProto, helper

from export_model.converters.formats.format import Port
from export_model.converters.formats.read import ports_of
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.signatures.errors import DamagedFileError, NotAPolicyError, SourceError
from fixtures import path as fixture
from tests.commands import export_model


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    return next(iter(export([fixture("recurrent")], ExportOptions(out, verify="none")))).folder


def test_every_format_of_a_bundle_has_the_same_ports(bundle: Path) -> None:
    content = json.loads((bundle / "policy.json").read_text())
    found = ports_of(bundle)
    assert [kind.key for kind, _ in found] == ["bytes", "saved_model", "tfjs", "onnx"]
    for _, interface in found:
        inputs = {p.name: p for p in interface.inputs}
        assert set(inputs) == {i["name"] for i in content["inputs"]}
        assert {o["name"] for o in content["outputs"]} <= {p.name for p in interface.outputs}
        for entry in content["inputs"]:
            port = inputs[entry["name"]]
            assert port.shape == tuple(entry["shape"])
            assert port.dtype == entry["dtype"]


def test_a_graph_is_open_and_the_others_name_their_outputs(bundle: Path) -> None:
    graph, *others = [ports for _, ports in ports_of(bundle)]
    assert graph.open
    assert not any(i.open for i in others)
    assert len(graph.outputs) > len(others[0].outputs) == len(others[1].outputs) == len(others[2].outputs)


def test_a_file_inside_stands_for_its_folder(bundle: Path) -> None:
    for file in ("saved_model/saved_model.pb", "tfjs/model.json"):
        (inside,), (folder,) = ports_of(bundle / file), ports_of((bundle / file).parent)
        assert inside == folder


def test_stored_weights_are_no_inputs_and_an_odd_dtype_is_not_known(tmp_path: Path) -> None:
    weight = helper.make_tensor("w", TensorProto.FLOAT, [1], [2.0])
    ports = [
        helper.make_tensor_value_info("x", TensorProto.FLOAT, ["batch", 3]),
        helper.make_tensor_value_info("w", TensorProto.FLOAT, [1]),
        helper.make_tensor_value_info("s", TensorProto.STRING, None),
    ]
    result = helper.make_tensor_value_info("y", TensorProto.FLOAT, [7, 3])
    graph = helper.make_graph([helper.make_node("Mul", ["x", "w"], ["y"])], "g", ports, [result], [weight])
    file = tmp_path / "model.onnx"
    onnx.save(helper.make_model(graph), file)
    ((_, found),) = ports_of(file)
    assert found.inputs == (Port("x", "float32", (None, 3)), Port("s", None, None))
    assert found.outputs == (Port("y", "float32", (7, 3)),)


def test_an_op_that_nobody_knows_is_no_matter_here(tmp_path: Path, bundle: Path) -> None:
    model = onnx.load(next(bundle.glob("*.onnx")))
    model.graph.node[0].op_type = "Betainc"
    file = tmp_path / "model.onnx"
    onnx.save(model, file)
    assert {p.name for p in ports_of(file)[0][1].inputs} == {p.name for p in ports_of(bundle)[3][1].inputs}


def test_what_no_runtime_loads_by_itself_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "notes.txt"
    file.write_text("the policy is in the other folder\n")
    with pytest.raises(SourceError, match="cannot be compared") as caught:
        ports_of(file)
    assert "export it" in (caught.value.fix or "")


def test_damaged_files_are_named(tmp_path: Path, bundle: Path) -> None:
    (tmp_path / "model.json").write_text('{"modelTopology": {"node": [{"name": 1}]}, "format": "graph-model"}')
    with pytest.raises(DamagedFileError):
        ports_of(tmp_path / "model.json")
    cut = tmp_path / "cut.onnx"
    cut.write_bytes(next(bundle.glob("*.onnx")).read_bytes()[:-50])
    with pytest.raises(DamagedFileError):
        ports_of(cut)


def test_a_saved_model_without_a_signature_cannot_be_called(tmp_path: Path, bundle: Path) -> None:
    from export_model.converters.files import tensorflow_messages as schema

    message = schema.parse(schema.SavedModel, (bundle / "saved_model" / "saved_model.pb").read_bytes(), "SavedModel")
    message.meta_graphs[0].signature_def.clear()
    (tmp_path / "saved_model.pb").write_bytes(message.SerializeToString())
    with pytest.raises(NotAPolicyError, match="no signature"):
        ports_of(tmp_path)


@pytest.mark.parametrize("length", [-1, 0])
def test_a_batch_of_no_length_is_any(length: int, tmp_path: Path, bundle: Path) -> None:
    """Exporters write -1 or 0 for a free axis; as the importer has it, so has ``compare``."""
    model = onnx.load(next(bundle.glob("*.onnx")))
    for value in (*model.graph.input, *model.graph.output):
        value.type.tensor_type.shape.dim[0].dim_value = length
    file = tmp_path / "model.onnx"
    onnx.save(model, file)
    ((_, found),) = ports_of(file)
    assert {port.shape[0] for port in (*found.inputs, *found.outputs) if port.shape is not None} == {None}
    ran = export_model("compare", file, file, "--runtimes", "onnxruntime")
    assert ran.status == 0, ran.err + ran.out
