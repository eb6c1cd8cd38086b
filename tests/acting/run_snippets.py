"""Runs snippets as they were printed: ``python run_snippets.py < jobs.json > answers.json``, in the bundles' folder.

A job is {"kind": "python", "code": text}, or {"kind": "rest", "name": policy, "body": the body of the call}. TensorFlow
Serving is played here: its gRPC stub and its REST interface both call the signature that the request names.
"""

from __future__ import annotations

import collections
import contextlib
import io
import json
import sys
import types
from typing import Any

import numpy as np
from msgspec.structs import asdict


def serve(name: str, signature: str, feeds: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    import tensorflow as tf

    model = tf.saved_model.load(f"{name}/saved_model")
    called = model.signatures[signature]
    specs = called.structured_input_signature[1]
    assert set(feeds) == set(specs), (set(feeds), set(specs))
    given = {}
    for key, value in feeds.items():
        array = np.asarray(value)
        assert specs[key].shape.is_compatible_with(array.shape), (key, specs[key], array.shape)
        given[key] = tf.constant(array, specs[key].dtype)
    return {key: tensor.numpy() for key, tensor in called(**given).items()}


def serving_modules() -> dict[str, types.ModuleType]:
    """What ``import grpc`` and ``tensorflow_serving.apis`` find."""
    import tensorflow as tf

    class PredictRequest:
        def __init__(self) -> None:
            self.model_spec = types.SimpleNamespace(name="", signature_name="")
            self.inputs: Any = collections.defaultdict(tf.make_tensor_proto(0.0).__class__)

    class Stub:
        def __init__(self, channel: str) -> None:
            assert channel == "localhost:8500"

        def Predict(self, request: PredictRequest, timeout: float) -> Any:
            assert timeout > 0
            feeds = {name: tf.make_ndarray(tensor) for name, tensor in request.inputs.items()}
            for name, tensor in request.inputs.items():
                assert tf.make_ndarray(tensor).dtype == feeds[name].dtype
            answer = serve(request.model_spec.name, request.model_spec.signature_name, feeds)
            return types.SimpleNamespace(outputs={k: tf.make_tensor_proto(v) for k, v in answer.items()})

    grpc, package, apis = (types.ModuleType(n) for n in ("grpc", "tensorflow_serving", "tensorflow_serving.apis"))
    grpc.insecure_channel = lambda address: address  # type: ignore[attr-defined]
    apis.predict_pb2 = types.SimpleNamespace(PredictRequest=PredictRequest)  # type: ignore[attr-defined]
    apis.prediction_service_pb2_grpc = types.SimpleNamespace(PredictionServiceStub=Stub)  # type: ignore[attr-defined]
    return {"grpc": grpc, "tensorflow_serving": package, "tensorflow_serving.apis": apis}


def listed(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: listed(v) for k, v in value.items()}
    return value.tolist() if isinstance(value, np.ndarray) else value


def in_python(code: str) -> dict[str, Any]:
    if "tensorflow_serving" in code:
        sys.modules.update(serving_modules())
    names: dict[str, Any] = {"__name__": "__main__"}
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(code, "snippet", "exec"), names)
    decision = names.get("decision")
    if decision is not None:
        names["outputs"] = {k: v for k, v in asdict(decision).items() if k != "outputs" and v is not None}
    kept = {key: listed(names[key]) for key in ("feeds", "outputs", "action") if key in names}
    return {**kept, "printed": printed.getvalue()}


def in_serving(name: str, body: dict[str, Any]) -> dict[str, Any]:
    """The row format gives each agent's inputs without the batch axis, the column format all of them with it."""
    if "instances" in body:
        rows = body["instances"]
        feeds = {key: np.stack([np.asarray(row[key]) for row in rows]) for key in rows[0]}
    else:
        feeds = {key: np.asarray(value) for key, value in body["inputs"].items()}
    return {"feeds": listed(feeds), "outputs": listed(serve(name, body["signature_name"], feeds))}


def answer(job: dict[str, Any]) -> dict[str, Any]:
    return in_python(job["code"]) if job["kind"] == "python" else in_serving(job["name"], job["body"])


json.dump([answer(job) for job in json.load(sys.stdin)], sys.stdout)
