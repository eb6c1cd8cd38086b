"""Models as the PyTorch exporters of ML-Agents write them (opset 9), with random weights.

Forms by version: ../shared/docs/mlagents-contract.md §1.9; nodes as in the public files of ../shared/corpus/onnx.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.onnx_reader.models import Array, constant, declared, floats, helper, node

OBS, HIDDEN, ACTIONS = 6, 8, 2


@dataclass(frozen=True)
class Form:
    """What a generation's exporter is asked to write."""

    version: str  # 0.20, 0.22, 0.23, 0.25, 0.26, 0.28
    continuous: bool = False
    branches: Sequence[int] = ()
    sac: bool = False
    recurrent: bool = False
    #: torch 1.9 and later write constants as Identity of an initializer with another name
    identities: bool = False
    #: no mask was used in training: the input is declared and missing, or not there at all
    masks: bool = True

    @property
    def number(self) -> float:
        return float(self.version)


class Exporter:
    """Writes one model."""

    def __init__(self, form: Form) -> None:
        self.form = form
        self.nodes: list[Any] = []
        self.inputs: list[Any] = []
        self.outputs: list[Any] = []
        self.constants: dict[str, Array] = {}
        self.count = 20

    # ---- small parts

    def name(self) -> str:
        self.count += 1
        return str(self.count)

    def add(self, kind: str, inputs: Sequence[str], output: str | None = None, **attributes: Any) -> str:
        output = output or self.name()
        self.nodes.append(node(kind, inputs, output, **attributes))
        return output

    def const(self, value: Any, dtype: Any = np.float32) -> str:
        name = self.name()
        self.nodes.append(constant(name, value, dtype))
        return name

    def weights(self, *shape: int) -> str:
        name = f"layer.{len(self.constants)}.weight"
        self.constants[name] = floats(*shape, seed=len(self.constants), scale=0.7)
        return name

    def dense(self, x: str, size: int, out: int) -> str:
        return self.add("Gemm", [x, self.weights(out, size), self.weights(out)], alpha=1.0, beta=1.0, transB=1)

    def swish(self, x: str) -> str:
        return self.add("Mul", [x, self.add("Sigmoid", [x])])

    def input(self, name: str, *dims: Any) -> str:
        self.inputs.append(declared(name, np.float32, ["batch", *dims]))
        return name

    def output(self, name: str, dims: Sequence[Any], dtype: Any = np.float32) -> None:
        self.outputs.append(declared(name, dtype, dims))

    def number(self, name: str, value: Any) -> None:
        """A constant that is an output."""
        array = np.asarray(value, np.float32)
        self.output(name, array.shape)
        if self.form.identities:
            self.constants[f"{name}.1"] = array
            self.add("Identity", [f"{name}.1"], name)
        else:
            self.constants[name] = array

    # ---- the policy

    def write(self) -> Any:
        form = self.form
        torch_names = form.number >= 0.26
        self.x = self.input("obs_0" if torch_names else "vector_observation", OBS)
        body = self.swish(self.dense(self.normalised(self.x), OBS, HIDDEN))
        if form.branches and form.masks:
            self.mask = self.input("action_masks", sum(form.branches))
        memory = 2 * HIDDEN if form.recurrent else 0
        if form.recurrent:
            body = self.lstm(body)
        constants: list[tuple[str, Any]] = [
            ("version_number", [3.0 if torch_names else 2.0]),
            ("memory_size", [memory]),
        ]
        if form.number < 0.23:
            self.old(body)
        else:
            self.by_kind(body)
        for name, value in constants:
            self.number(name, value)
        if form.recurrent and form.number >= 0.25:
            self.output("recurrent_out", [1, 1, 2 * HIDDEN])
        graph = helper.make_graph(
            self.nodes, "torch-jit-export", self.inputs, self.outputs,
            [helper.make_tensor(n, 1, a.shape, a.tobytes(), raw=True) for n, a in self.constants.items()],
        )  # fmt: skip
        return helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", 9)],
            producer_name="pytorch",
            producer_version="1.7",
            ir_version=6,
        )

    def normalised(self, x: str) -> str:
        self.constants["running_mean"] = floats(OBS, seed=90)
        self.constants["deviation"] = np.abs(floats(OBS, seed=91)) + np.float32(0.5)
        y = self.add("Div", [self.add("Sub", [x, "running_mean"]), "deviation"])
        return self.add("Clip", [y], min=-5.0, max=5.0)

    def lstm(self, x: str) -> str:
        turned = self.form.number >= 0.26
        memory = self.input("recurrent_in" if self.form.number >= 0.25 else "memories", 1, 2 * HIDDEN)
        x = self.add("Reshape", [x, self.const([-1, 1, HIDDEN], np.int64)])
        if turned:
            memory = self.add("Transpose", [memory], perm=[1, 0, 2])
        h = self.add("Slice", [memory], axes=[2], starts=[0], ends=[HIDDEN])
        c = self.add("Slice", [memory], axes=[2], starts=[HIDDEN], ends=[2**63 - 1])
        x = self.add("Transpose", [x], perm=[1, 0, 2])
        kernels = [
            self.weights(1, 4 * HIDDEN, HIDDEN),
            self.weights(1, 4 * HIDDEN, HIDDEN),
            self.weights(1, 8 * HIDDEN),
        ]
        y, yh, yc = self.name(), self.name(), self.name()
        self.nodes.append(node("LSTM", [x, *kernels, "", h, c], [y, yh, yc], hidden_size=HIDDEN))
        y = self.add("Transpose", [self.add("Squeeze", [y], axes=[1])], perm=[1, 0, 2])
        if self.form.number >= 0.25:
            joined = self.add("Concat", [yh, yc], None if turned else "recurrent_out", axis=-1)
            if turned:
                self.add("Transpose", [joined], "recurrent_out", perm=[1, 0, 2])
        return self.add("Reshape", [y, self.const([-1, HIDDEN], np.int64)])

    def old(self, body: str) -> None:
        """0.20 to 0.22: one output, ``action``."""
        form = self.form
        if form.continuous:
            sample, _ = self.gaussian(body, clip=form.number >= 0.22, last_axis=True)
            self.add("Identity", [sample], "action")
            self.output("action", ["batch", ACTIONS, 1])
            size = ACTIONS
        else:
            self.add("Concat", self.log_probs(body, branch_constant=True), "action", axis=1)
            size = sum(form.branches)
            self.output("action", ["batch", size])
        self.number("is_continuous_control", [float(form.continuous)])
        self.number("action_output_shape", [size])

    def by_kind(self, body: str) -> None:
        form = self.form
        size = sum(form.branches)
        if form.continuous:
            sample, mean = self.gaussian(body, clip=True)
            self.add("Identity", [sample], "continuous_actions")
            self.output("continuous_actions", ["batch", ACTIONS])
            self.number("continuous_action_output_shape", [ACTIONS])
            if form.number >= 0.28:
                self.add("Identity", [mean], "deterministic_continuous_actions")
                self.output("deterministic_continuous_actions", [f"{mean}_dim_0", ACTIONS])
        if form.branches and form.number < 0.26:
            parts = self.log_probs(body, branch_constant=True)
            self.add("Concat", parts, "discrete_actions", axis=1)
            self.output("discrete_actions", ["batch", size])
            self.number("discrete_action_output_shape", [size])
        elif form.branches:
            parts = self.log_probs(body, branch_constant=False)
            draws = [self.add("Multinomial", [p], dtype=7, sample_size=1) for p in parts]
            self.add("Concat", draws, "discrete_actions", axis=1)
            self.output("discrete_actions", ["batch", len(draws)], np.int64)
            self.number("discrete_action_output_shape", [list(form.branches)])
            if form.number >= 0.28:
                best = [self.add("ArgMax", [p], axis=1, keepdims=1) for p in parts]
                self.add("Concat", best, "deterministic_discrete_actions", axis=1)
                self.output("deterministic_discrete_actions", ["best_dim_0", len(best)], np.int64)
        if form.number < 0.26 and not (form.continuous and form.branches):
            if form.continuous:
                sample, _ = self.gaussian(body, clip=True)  # called a second time: another draw
                self.add("Identity", [sample], "action")
            else:
                self.add("Concat", parts, "action", axis=1)
            self.output("action", ["batch", ACTIONS if form.continuous else size])
            self.number("is_continuous_control", [float(form.continuous)])
            self.number("action_output_shape", [ACTIONS if form.continuous else size])

    def gaussian(self, body: str, *, clip: bool, last_axis: bool = False) -> tuple[str, str]:
        """(the sample, the action without chance)."""
        if not hasattr(self, "mu"):
            self.mu = self.dense(body, HIDDEN, ACTIONS)
            self.constants["log_sigma"] = floats(1, ACTIONS, seed=95, scale=0.3)
            self.sigma = self.add("Exp", ["log_sigma"])
        draw = self.add("RandomNormalLike", [self.mu], dtype=1)
        sample = self.add("Add", [self.mu, self.add("Mul", [draw, self.sigma])])
        if last_axis:
            sample = self.add("Concat", [self.add("Unsqueeze", [sample], axes=[-1])], axis=-1)
        if self.form.sac:
            return self.add("Tanh", [sample]), self.mu  # the raw mean, as 0.28 to 1.1 export it
        results = []
        for value in (sample, self.mu):
            if clip:
                clipped = self.add("Clip", [value], min=-3.0, max=3.0)
                value = self.add("Div", [clipped, self.const(3.0)])
            results.append(value)
        return results[0], results[1]

    def log_probs(self, body: str, *, branch_constant: bool) -> list[str]:
        parts, start = [], 0
        for size in self.form.branches:
            logits = self.dense(body, HIDDEN, size)
            if self.form.masks:
                mask = self.add("Slice", [self.mask], axes=[1], starts=[start], ends=[start + size])
                forbidden = self.add("Add", [self.add("Mul", [mask, self.const(-1.0)]), self.const(1.0)])
                kept = self.add("Mul", [logits, mask])
                logits = self.add("Sub", [kept, self.add("Mul", [forbidden, self.const(1e8)])])
            start += size
            probabilities = self.add("Softmax", [logits], axis=1)
            if branch_constant:
                probabilities = self.add("Add", [probabilities, self.const(1e-7)])
            parts.append(self.add("Log", [probabilities]))
        return parts


def policy(version: str, **more: Any) -> Any:
    """A model of a version; the fields of ``Form`` say which."""
    return Exporter(Form(version, **more)).write()


__all__ = ["ACTIONS", "HIDDEN", "OBS", "Exporter", "Form", "policy"]
