"""Snippets for TensorFlow Serving: the container, a REST call, a gRPC call.

TensorFlow Serving loads ``/models/NAME/VERSION/saved_model.pb``. Its REST interface takes ``instances`` (row format: an
object per agent, without the batch axis) where every input has the batch axis, else ``inputs`` (column format); see
TensorFlow Serving's api_rest.md. A gRPC call takes a PredictRequest (predict.proto).
"""

from __future__ import annotations

import json
import math
from typing import Any

from export_model.converters.formats.registry import SAVED_MODEL
from export_model.exporter.snippets.contract import (
    SnippetBundle,
    action_meaning,
    example_shape,
    fill_template,
    meaning,
    string_literal,
)
from export_model.exporter.snippets.python import play
from export_model.signatures.roles import Role
from export_model.signatures.spec import TensorSpec

#: A body of more numbers is made by a command instead of being printed.
_MOST_NUMBERS = 400


def docker(bundle: SnippetBundle) -> str:
    """The container."""
    return fill_template("serving_docker.sh", folder=bundle.mount(SAVED_MODEL.main_of(bundle.name)), name=bundle.name)


def rest(bundle: SnippetBundle) -> str:
    """A call with curl."""
    inputs = bundle.signature.inputs
    rows = all(s.batched for s in inputs)
    texts = [line for spec in inputs for line in meaning(bundle, spec)]
    texts += [line for head in bundle.heads for line in action_meaning(bundle, head)]
    comments = "\n".join(f"# {line}" for line in texts)
    shapes = {s.name: example_shape(s)[1:] if rows else example_shape(s) for s in inputs}
    if sum(math.prod(shape) for shape in shapes.values()) <= _MOST_NUMBERS:
        body = _body({s.name: _nested_list(_value(s), shapes[s.name]) for s in inputs}, rows)
        return fill_template("serving_rest.sh", name=bundle.name, comments=comments, body=body)
    calls = (
        f"{string_literal(s.name)}: full({', '.join([repr(_value(s)), *map(str, shapes[s.name])])})" for s in inputs
    )
    feeds = f"{{{', '.join(calls)}}}"
    given = f'"instances": [{feeds}]' if rows else f'"inputs": {feeds}'
    body = f'{{"signature_name": "serving_default", {given}}}'
    return fill_template("serving_rest_large.sh", name=bundle.name, comments=comments, body=body)


def grpc(bundle: SnippetBundle) -> str:
    """A call from Python."""
    run = [
        "request = predict_pb2.PredictRequest()",
        f"request.model_spec.name = {string_literal(bundle.name)}",
        'request.model_spec.signature_name = "serving_default"',
        "for name, value in feeds.items():",
        "    request.inputs[name].CopyFrom(tf.make_tensor_proto(value))",
        "answer = stub.Predict(request, 10.0)  # seconds",
        "outputs = {name: tf.make_ndarray(tensor) for name, tensor in answer.outputs.items()}",
    ]
    return fill_template("serving_grpc.py", play=play(bundle, run))


def _body(feeds: dict[str, Any], rows: bool) -> str:
    """A line per input."""
    lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in feeds.items())
    given = f'"instances": [{{\n{lines}\n}}]' if rows else f'"inputs": {{\n{lines}\n}}'
    return f'{{"signature_name": "serving_default", {given}}}'


def _value(spec: TensorSpec) -> float | int | bool:
    one = spec.role is Role.MASKS
    return one if spec.dtype == "bool" else int(one) if spec.dtype.startswith(("int", "uint")) else float(one)


def _nested_list(value: float, shape: tuple[int, ...]) -> Any:
    return [_nested_list(value, shape[1:]) for _ in range(shape[0])] if shape else value
