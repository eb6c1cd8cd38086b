"""Bundles of the zoo, whose hashes fit what was put into them."""

from __future__ import annotations

import json
from pathlib import Path

from export_model.converters.files import tensorflow_messages as schema
from export_model.signatures.digest import sha256_hex
from tests.hostile.making import (
    case,
    elsewhere,
    writer,
)


def rehashed(bundle: Path) -> Path:
    """The bundle with the hashes of what now lies in it."""
    content = json.loads((bundle / "policy.json").read_bytes())
    for name in content["files"]:
        data = (bundle / name).read_bytes()
        content["files"][name] = {"sha256": sha256_hex(data), "bytes": len(data)}
    (bundle / "policy.json").write_text(json.dumps(content))
    return bundle


def _bundle_cases() -> None:
    def bytes_(folder: Path, marker: Path) -> Path:
        (path,) = folder.glob("*.bytes")
        graph = schema.GraphDef.FromString(path.read_bytes())
        graph.node.extend(writer(marker))
        next(n for n in graph.node if n.name == "action").input.append("^write_file")
        path.write_bytes(schema.serialise(graph))
        return rehashed(folder)

    def saved_model(folder: Path, marker: Path) -> Path:
        path = folder / "saved_model/saved_model.pb"
        message = schema.SavedModel.FromString(path.read_bytes())
        graph = message.meta_graphs[0].graph_def
        graph.node.extend(writer(marker))
        next(n for n in graph.node if n.name == "action").input.append("^write_file")
        path.write_bytes(schema.serialise(message))
        return rehashed(folder)

    def init(folder: Path, marker: Path) -> Path:
        path = folder / "saved_model/saved_model.pb"
        message = schema.SavedModel.FromString(path.read_bytes())
        meta = message.meta_graphs[0]
        meta.graph_def.node.extend(writer(marker))
        meta.signature_def["__saved_model_init_op"].outputs["__saved_model_init_op"].name = "write_file"
        path.write_bytes(schema.serialise(message))
        return rehashed(folder)

    def tfjs_elsewhere(folder: Path, marker: Path) -> Path:
        path = folder / "tfjs/model.json"
        model = json.loads(path.read_bytes())
        model["weightsManifest"][0]["paths"] = ["../../../../../../etc/passwd"]
        path.write_text(json.dumps(model))
        return rehashed(folder)

    def tfjs_many(folder: Path, marker: Path) -> Path:
        path = folder / "tfjs/model.json"
        model = json.loads(path.read_bytes())
        model["weightsManifest"][0]["paths"] *= 100_000
        path.write_text(json.dumps(model))
        return rehashed(folder)

    def tfjs_op(folder: Path, marker: Path) -> Path:
        path = folder / "tfjs/model.json"
        model = json.loads(path.read_bytes())
        next(n for n in model["modelTopology"]["node"] if n["name"] == "action")["op"] = "WriteFile"
        path.write_text(json.dumps(model))
        return rehashed(folder)

    def onnx_elsewhere(folder: Path, marker: Path) -> Path:
        (path,) = folder.glob("*.onnx")
        path.write_bytes(elsewhere(path.read_bytes(), "../../../../../../../../etc/passwd"))
        return rehashed(folder)

    makers = {
        "a writer in the .bytes": bytes_,
        "a writer in the SavedModel": saved_model,
        "an init op in the SavedModel": init,
        "weights of the TensorFlow.js model elsewhere": tfjs_elsewhere,
        "weights of the TensorFlow.js model named 100,000 times": tfjs_many,
        "an op that writes in the TensorFlow.js model": tfjs_op,
        "weights of the ONNX elsewhere": onnx_elsewhere,
    }
    for label, make in makers.items():
        case(f"bundle, {label}", "bundle")(make)


_bundle_cases()
