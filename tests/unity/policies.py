"""Small policies for the checker's tests, made here: a base that every release accepts, and one change at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper

Dims = Sequence[int | str | None]


@dataclass
class Draft:
    """A policy of one dense layer; ``constants`` become outputs through Identity."""

    inputs: dict[str, tuple[int, Dims]] = field(default_factory=lambda: {"obs_0": (TensorProto.FLOAT, ["N", 5])})
    actions: dict[str, int] = field(
        default_factory=lambda: {"continuous_actions": 2, "deterministic_continuous_actions": 2}
    )
    constants: dict[str, Any] = field(
        default_factory=lambda: {"version_number": 3.0, "memory_size": 0.0, "continuous_action_output_shape": 2.0}
    )
    types: Mapping[str, Any] = field(default_factory=dict)
    extra: list[Any] = field(default_factory=list)
    opset: int = 9

    def model(self) -> Any:
        rng = np.random.default_rng(0)
        first = next(iter(self.inputs))
        nodes, initializers, outputs = [], [], []
        width = self.inputs[first][1][-1]
        x = first
        if self.inputs[first][0] != TensorProto.FLOAT:
            nodes.append(helper.make_node("Cast", [first], ["as_float"], to=TensorProto.FLOAT))
            x = "as_float"
        for name, size in self.actions.items():
            held = width if isinstance(width, int) and width > 0 else 5
            initializers += [
                numpy_helper.from_array(rng.standard_normal((held, size)).astype(np.float32), f"{name}/w"),
                numpy_helper.from_array(rng.standard_normal(size).astype(np.float32), f"{name}/b"),
            ]
            nodes.append(helper.make_node("Gemm", [x, f"{name}/w", f"{name}/b"], [name]))
            outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size]))
        for name, value in self.constants.items():
            array = np.atleast_1d(np.asarray(value, self.types.get(name, np.float32)))
            initializers.append(numpy_helper.from_array(array, f"{name}/value"))
            nodes.append(helper.make_node("Identity", [f"{name}/value"], [name]))
            outputs.append(
                helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(array.dtype), array.shape)
            )
        inputs = [helper.make_tensor_value_info(n, kind, dims) for n, (kind, dims) in self.inputs.items()]
        graph = helper.make_graph([*nodes, *self.extra], "policy", inputs, outputs, initializers)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", self.opset)], ir_version=6)

    def write(self, folder: Path, name: str = "policy.onnx") -> Path:
        path = folder / name
        path.write_bytes(self.model().SerializeToString())
        return path
