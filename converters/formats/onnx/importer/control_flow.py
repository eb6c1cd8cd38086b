"""Ops with bodies: branches whose condition is known, loops that run once."""

from __future__ import annotations

from collections.abc import Mapping

from export_model.converters.formats.onnx.importer.importer import Importer
from export_model.converters.formats.onnx.importer.node import Op, Translate


def _if(op: Op, net: Importer) -> list[str | None]:
    condition = net.constant_of(op.need(0))
    if condition is None:
        raise op.op_error(
            "its condition is not known before the graph runs",
            "which branch is taken would differ from run to run",
            "if an input decides it, give it a value: --set NAME=VALUE; else export the model with fixed shapes",
        )
    body = op.body("then_branch" if bool(condition.reshape(-1)[0]) else "else_branch")
    return [*net.inline(op, body, {})]


def _scan(op: Op, net: Importer) -> list[str | None]:
    """tf2onnx's form of an LSTM loop: states go in and out, an axis is walked along. Here it has one step.

    Opset 8 had a batch axis and sequence lengths of its own; nobody writes that.
    """
    body = op.body("body")
    walked = op.integer("num_scan_inputs", 0)
    states = len(op.inputs) - walked
    if op.opset < 9 or walked < 1 or states < 0 or len(body.input) != len(op.inputs):
        raise op.op_error("its inputs do not fit its body", "opset 9 and later are read")
    given = op.integers("scan_input_axes", (0,) * walked) or ()
    made = len(body.output) - states
    stacked = op.integers("scan_output_axes", (0,) * made) or (0,) * made
    bindings = {}
    for position, value in enumerate(body.input):
        tensor = op.need(position)
        if position >= states:
            axis = net.axis(tensor, given[position - states])
            if net.shape(tensor)[axis] != 1:
                raise op.op_error(
                    f"it runs over {net.shape(tensor)[axis]} steps",
                    "a policy is run for one step, its memory fed back by the caller",
                    "if an input gives the number of steps, fix it: --set NAME=1",
                )
            tensor = net.squeeze(tensor, [axis])
        bindings[value.name] = tensor
    results = net.inline(op, body, bindings)
    ends: list[str | None] = [*results[:states]]
    for value, axis in zip(results[states:], stacked, strict=True):
        ends.append(net.expand_dims(value, net.axis_of(axis, net.rank(value) + 1)))
    return ends


def _loop(op: Op, net: Importer) -> list[str | None]:
    """Refused: no exporter of policies writes one (tf2onnx writes Scan, PyTorch LSTM)."""
    raise op.op_error(
        "it is a loop",
        "how often it runs is decided while the graph runs",
        "export the model with sequences of length 1, without a loop over time",
    )


OPS: Mapping[str, Translate] = {"If": _if, "Scan": _scan, "Loop": _loop}
