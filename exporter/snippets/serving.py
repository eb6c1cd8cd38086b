"""Snippets for TensorFlow Serving: the container, a REST call, a gRPC call.

TensorFlow Serving loads ``/models/NAME/VERSION/saved_model.pb``. Its REST interface takes ``instances`` (row format: an
object per agent, without the batch axis) where every input has the batch axis, else ``inputs`` (column format); see
TensorFlow Serving's api_rest.md. A gRPC call takes a PredictRequest (predict.proto).
"""

from __future__ import annotations

import json
import math
from string import Template
from typing import Any

from exporter.snippets.contract import Bundle, action_meaning, example_shape, meaning, quoted
from exporter.snippets.python import play
from signatures.roles import Role
from signatures.spec import TensorSpec

#: A body of more numbers is made by a command instead of being printed.
_MOST_NUMBERS = 400

_DOCKER = Template("""\
# REST on port 8501, gRPC on port 8500
docker run --rm -p 8500:8500 -p 8501:8501 \\
  --mount type=bind,source=$folder,target=/models/$name/1,readonly \\
  -e MODEL_NAME=$name tensorflow/serving
""")

_CURL = Template("""\
# The outputs come back by name, a row per agent; GET .../v1/models/$name/metadata says what it takes.
$comments
curl -s -X POST http://localhost:8501/v1/models/$name:predict \\
  -H 'Content-Type: application/json' -d @- <<'JSON'
$body
JSON
""")

_CURL_LARGE = Template("""\
# The outputs come back by name, a row per agent; GET .../v1/models/$name/metadata says what it takes.
$comments
python3 - <<'PYTHON' > request.json
import json

def full(value, *shape):
    return [full(value, *shape[1:]) for _ in range(shape[0])] if shape else value

print(json.dumps($body))
PYTHON
curl -s -X POST http://localhost:8501/v1/models/$name:predict \\
  -H 'Content-Type: application/json' -d @request.json
""")

_GRPC = Template("""\
# pip install tensorflow-serving-api
import grpc
import numpy as np
import tensorflow as tf
from tensorflow_serving.apis import predict_pb2, prediction_service_pb2_grpc

stub = prediction_service_pb2_grpc.PredictionServiceStub(grpc.insecure_channel("localhost:8500"))
$play""")


def docker(bundle: Bundle) -> str:
    """The container."""
    return _DOCKER.substitute(folder=bundle.mount("saved_model"), name=bundle.name)


def rest(bundle: Bundle) -> str:
    """A call with curl."""
    inputs = bundle.signature.inputs
    rows = all(s.shape and s.shape[0] is None for s in inputs)
    texts = [line for spec in inputs for line in meaning(bundle, spec)]
    texts += [line for head in bundle.heads for line in action_meaning(bundle, head)]
    comments = "\n".join(f"# {line}" for line in texts)
    shapes = {s.name: example_shape(s)[1:] if rows else example_shape(s) for s in inputs}
    if sum(math.prod(shape) for shape in shapes.values()) <= _MOST_NUMBERS:
        body = _body({s.name: _nested(_value(s), shapes[s.name]) for s in inputs}, rows)
        return _CURL.substitute(name=bundle.name, comments=comments, body=body)
    calls = (f"{quoted(s.name)}: full({', '.join([repr(_value(s)), *map(str, shapes[s.name])])})" for s in inputs)
    feeds = f"{{{', '.join(calls)}}}"
    given = f'"instances": [{feeds}]' if rows else f'"inputs": {feeds}'
    body = f'{{"signature_name": "serving_default", {given}}}'
    return _CURL_LARGE.substitute(name=bundle.name, comments=comments, body=body)


def grpc(bundle: Bundle) -> str:
    """A call from Python."""
    run = [
        "request = predict_pb2.PredictRequest()",
        f"request.model_spec.name = {quoted(bundle.name)}",
        'request.model_spec.signature_name = "serving_default"',
        "for name, value in feeds.items():",
        "    request.inputs[name].CopyFrom(tf.make_tensor_proto(value))",
        "answer = stub.Predict(request, 10.0)  # seconds",
        "outputs = {name: tf.make_ndarray(tensor) for name, tensor in answer.outputs.items()}",
    ]
    return _GRPC.substitute(play=play(bundle, run))


def _body(feeds: dict[str, Any], rows: bool) -> str:
    """A line per input."""
    lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in feeds.items())
    given = f'"instances": [{{\n{lines}\n}}]' if rows else f'"inputs": {{\n{lines}\n}}'
    return f'{{"signature_name": "serving_default", {given}}}'


def _value(spec: TensorSpec) -> float | int | bool:
    one = spec.role is Role.MASKS
    return one if spec.dtype == "bool" else int(one) if spec.dtype.startswith(("int", "uint")) else float(one)


def _nested(value: float, shape: tuple[int, ...]) -> Any:
    return [_nested(value, shape[1:]) for _ in range(shape[0])] if shape else value
