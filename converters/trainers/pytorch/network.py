"""The layers that ML-Agents' PyTorch networks are made of, as nodes of the TensorFlow vocabulary.

Source: mlagents/trainers/torch_entities/{layers,encoders,distributions}.py of 1.1.0, mlagents/trainers/torch/… before
0.30; the layers did not change from 0.22 on. Linear weights are [out, in], LSTM gates in the order i, f, g, o.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence

import numpy as np

from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn.activations import Activation, clip
from export_model.converters.graph.nn.convolution import Window, conv2d
from export_model.converters.graph.nn.linear import matmul
from export_model.converters.graph.nn.recurrent import gru, lstm
from export_model.converters.graph.nodes import NameScope, Node
from export_model.converters.graph.types import FLOAT32, INT32, INT64
from export_model.converters.trainers.pytorch.weights import Weights

#: Added before a logarithm (``EPSILON`` in distributions.py).
TINY = 1e-7
#: What a forbidden action's logit becomes: sb3_contrib/common/maskable/distributions.py, and rl_games'
#: common/extensions/distributions.py.
_FORBIDDEN = -1e8
_TO_NHWC, _TO_NCHW = (0, 2, 3, 1), (0, 3, 1, 2)


class Network(Builder):
    """Nodes in the making; methods read the weights they need from the state dictionary."""

    def __init__(self, state: Weights) -> None:
        # Nodes are called <module>/<op>; inputs and outputs, without a slash, cannot meet them.
        super().__init__(NameScope(()))
        self.state = state

    def input(self, name: str, *shape: int) -> str:
        """A float32 input [B, *shape]."""
        return self.named_input(name, FLOAT32, (None, *shape), name)

    def output(self, name: str, reference: str) -> None:
        """Call a tensor by the name of an output."""
        self.append(Node(name, "Identity", (reference,), origin=name))

    def fact(self, name: str, value: np.ndarray) -> None:
        """An output that is a constant."""
        self.append(Node(name, "Const", value=value.astype(np.float32), origin=name))

    def at(self, module: str) -> None:
        """Name the nodes that follow after a module."""
        self.prefix = re.sub(r"[^A-Za-z0-9_/\-]", "_", module.replace(".", "/")).strip("_/")

    def width(self, reference: str) -> int:
        """The last axis of a tensor."""
        return self.length(reference, -1)

    # ------------------------------------------------------------------ layers

    def linear(self, x: str, module: str, out: int | None = None, *, biased: bool = True) -> str:
        """``nn.Linear``: x·Wᵀ + b over the last axis."""
        self.at(module)
        weight = self.state.array(f"{module}.weight", out, self.width(x))
        bias = self.state.array(f"{module}.bias", len(weight)) if biased else None
        product = matmul(self, x, self.const(weight.T, "kernel"))
        return product if bias is None else self.add("BiasAdd", [product, self.const(bias, "bias")])

    def normalise(self, x: str, module: str) -> str:
        """``Normalizer``: clamp((x − mean) / sqrt(variance / steps), −5, 5)."""
        self.at(module)
        mean, variance = (self.state.array(f"{module}.running_{k}", self.width(x)) for k in ("mean", "variance"))
        steps = self.floats(self.state.number(f"{module}.normalization_steps"))
        spread = self.add("RealDiv", [self.const(variance, "variance"), steps])
        centred = self.add("Sub", [x, self.const(mean, "mean")])
        return clip(self, self.add("RealDiv", [centred, self.add("Sqrt", [spread])]), -5, 5)

    def empirical(self, x: str, module: str) -> str:
        """``EmpiricalNormalization`` of rsl_rl and FastTD3: (x − mean) / (deviation + 0.01); x where there is none."""
        if f"{module}._mean" not in self.state:
            return x
        mean, deviation = (
            self.state.array(name, *(1,) * (len(self.state.shape(name)) - 1), self.width(x)).reshape(-1)
            for name in (f"{module}._mean", f"{module}._std")
        )
        self.state.forget(f"{module}._var", f"{module}.count")
        self.at(module)
        centred = self.add("Sub", [x, self.const(mean, "mean")])
        return self.add("RealDiv", [centred, self.const((deviation + FLOAT32.type(1e-2)).astype(FLOAT32), "deviation")])

    def lstm(self, x: str, memory: str, module: str) -> tuple[str, str]:
        """One step of ``nn.LSTM``. ``memory`` is [B, 1, 2H], h before c. Returns the output [B, H] and the memory."""
        hidden, *kind = rnn_sizes(self.state, module)
        if kind != [4, 1]:
            raise self.state.unsupported_error(module, "its weights are not those of an LSTM with one layer")
        self.at(module)
        x, after = self.recurrent(x, self.reshape(memory, (-1, 2 * hidden)), module)
        return x, self.reshape(after, (-1, 1, 2 * hidden))

    def mlp(self, x: str, module: str, activation: Activation, *, ends: bool = False, biased: bool = True) -> str:
        """``nn.Sequential`` of linear layers with an activation after each, not after the last where it ``ends``.

        Raises SourceError where something else that has weights stands between them.
        """
        found = self.state.indices(f"{module}.")
        if found != list(range(0, 2 * len(found), 2)):
            raise self.state.unsupported_error(
                f"{module} (with weights at {', '.join(map(str, found[:8]))})",
                "a linear layer and an activation by turns are expected",
            )
        for index in found:
            x = self.linear(x, f"{module}.{index}", biased=biased)
            if index != found[-1] or not ends:
                x = activation(self, x)
        return x

    def recurrent(self, x: str, memory: str, module: str) -> tuple[str, str]:
        """One step of ``nn.LSTM`` or ``nn.GRU`` of any number of layers, by their weights' shapes.

        ``memory`` is [B, …]: the layers' h, then (LSTM) their c. Returns the output [B, H] and the new memory.
        """
        hidden, gates, layers = rnn_sizes(self.state, module)
        after: dict[str, list[str]] = {"h": [], "c": []}
        for layer in range(layers):
            kernel = self.state.array(f"{module}.weight_ih_l{layer}", gates * hidden, self.width(x))
            inner = self.state.array(f"{module}.weight_hh_l{layer}", gates * hidden, hidden)
            biases = [self.state.array(f"{module}.bias_{k}_l{layer}", gates * hidden) for k in ("ih", "hh")]
            self.at(module)
            h = self.slice(memory, 1, layer * hidden, (layer + 1) * hidden)
            if gates == 4:
                c = self.slice(memory, 1, (layers + layer) * hidden, (layers + layer + 1) * hidden)
                product = self.add("MatMul", [x, self.const(kernel.T, "kernel")])
                recurrent = self.const(inner.T, "recurrent_kernel")
                x, cell = lstm(self, product, h=h, c=c, recurrent=recurrent, bias=biases[0] + biases[1], gates="ifgo")
                after["c"].append(cell)
            else:
                order = (1, 0, 2)  # PyTorch has r, z, n; the layer is given z, r, n
                parts = [np.split(w, 3)[i].T for w in (kernel, inner) for i in order]
                kernels = [self.const(w, "kernel") for w in parts]
                shifts = [np.split(v, 3)[i] for v in biases for i in order]
                x = gru(self, x, h, kernels[:3], kernels[3:], shifts, linear_before_reset=True)
            after["h"].append(x)
        self.at(module)
        return x, self.concat([*after["h"], *after["c"]], 1)

    def remembering(self, x: str, module: str) -> tuple[str, tuple[str, ...]]:
        """``recurrent``, its memory an input and an output of the policy. Returns the output, the memory's parts."""
        hidden, gates, layers = rnn_sizes(self.state, module)
        parts = ("h", "c") if gates == 4 else ("h",)
        x, after = self.recurrent(x, self.input("recurrent_in", len(parts) * layers * hidden), module)
        self.output("recurrent_out", after)
        return x, parts

    # ------------------------------------------------------------------ images, NHWC inside

    def nhwc(self, image: str) -> str:
        """An image [B, C, H, W] as TensorFlow's ops want it."""
        return self.transpose(image, _TO_NHWC)

    def flat(self, image: str) -> str:
        """An image [B, H, W, C] as rows, in PyTorch's order: C, H, W."""
        size = math.prod(self.length(image, axis) for axis in (1, 2, 3))
        return self.reshape(self.transpose(image, _TO_NCHW), (-1, size))

    def convolution(self, image: str, module: str, stride: int, padding: str = "VALID") -> str:
        """``nn.Conv2d`` on [B, H, W, C]; ``SAME`` is a padding of 1 around a kernel of 3 at stride 1."""
        kernel = self.state.shape(f"{module}.weight")
        window = Window(
            (kernel[-2], kernel[-1]) if len(kernel) == 4 else (1, 1), (stride, stride), same=padding == "SAME"
        )
        return self.convolve(image, module, window)

    def convolve(self, image: str, module: str, window: Window) -> str:
        """``nn.Conv2d`` on [B, H, W, C] with any strides and paddings; the kernel must have the window's size."""
        self.at(module)
        kernel = self.state.array(f"{module}.weight", None, self.width(image), *window.size)
        bias = self.state.array(f"{module}.bias", len(kernel))
        value = conv2d(self, image, np.ascontiguousarray(kernel.transpose(2, 3, 1, 0)), window)
        return self.add("BiasAdd", [value, self.const(bias, "bias")])

    def max_pool(self, image: str) -> str:
        """``nn.MaxPool2d([3, 3], [2, 2])``."""
        return self.add("MaxPool", [image], ksize=(1, 3, 3, 1), strides=(1, 2, 2, 1), padding="VALID")

    # ------------------------------------------------------------------ distributions

    def gaussian(self, x: str, module: str) -> tuple[str, str]:
        """``GaussianDistribution``: the mean and a draw, both [B, A]; the deviation may depend on x, as SAC's does."""
        mean = self.linear(x, f"{module}.mu")
        actions = self.width(mean)
        if f"{module}.log_sigma.weight" in self.state:
            log_sigma = clip(self, self.linear(x, f"{module}.log_sigma", actions), -20, 2)
        else:
            self.at(f"{module}.log_sigma")
            log_sigma = self.const(self.state.array(f"{module}.log_sigma", 1, actions), "log_sigma")
        self.at(module)
        noise = self.normals_like(mean, self.prefix)
        spread = self.add("Mul", [noise, self.add("Exp", [log_sigma])])
        return mean, self.add("Add", [mean, spread])

    def normals_like(self, mean: str, module: str) -> str:
        """Draws from N(0, 1), one for each number of ``mean``; ``module`` is whose, as reports of lifted noise say."""
        shape = self.add("Shape", [mean], "shape", out_type=INT32)
        origin = f"{module}/RandomStandardNormal"
        return self.add("RandomStandardNormal", [shape], origin=origin, dtype=FLOAT32)

    def highest(self, values: str, name: str | None = "q_values") -> None:
        """The outputs of a network of values per action: these by their name, and as ``action`` the highest's."""
        if name is not None:
            self.output(name, values)
        self.at("action")
        best = self.add("ArgMax", [values, self.ints(1, "axis")], output_type=INT64)
        self.output("action", self.reshape(best, (-1, 1)))

    def choice(self, logits: str) -> str:
        """A class of each row, drawn by its logits (``logits_0``, of the next ``logits_1`` …): int64 [B, 1]."""
        self.originate(logits, f"logits_{sum(n.op == 'Multinomial' for n in self.nodes)}")
        return self.add("Multinomial", [logits, self.ints(1, "count")], output_dtype=INT64)

    def choices(self, logits: str, sizes: Sequence[int]) -> str:
        """A class of each branch, drawn by its part of the logits: int64 [B, branches]."""
        starts = [0, *itertools.accumulate(sizes)]
        parts = [self.slice(logits, 1, *ends) if len(sizes) > 1 else logits for ends in itertools.pairwise(starts)]
        drawn = [self.choice(part) for part in parts]
        return drawn[0] if len(drawn) == 1 else self.concat(drawn, 1)

    def forbid(self, logits: str, masks: str) -> str:
        """The logits, −1e8 where the masks are 0."""
        kept = self.add("Mul", [logits, masks])
        blocked = self.add("Sub", [self.floats(1), masks])
        return self.add("Add", [kept, self.add("Mul", [blocked, self.floats(_FORBIDDEN)])])

    def branch(self, x: str, module: str, masks: str, start: int, *, twice: bool, preview: bool = False) -> str:
        """The probabilities of one branch of ``MultiCategoricalDistribution``, [B, actions].

        Masked logits become −1e8 (masks: 1 = allowed); 0.20 and 0.21 (``preview``) masked the probabilities. ``twice``:
        up to 0.22 the softmax of the logarithm of the probabilities was taken again.
        """
        logits = self.linear(x, module)
        mask = self.slice(masks, 1, start, start + self.width(logits))
        if preview:
            allowed = self.add("Mul", [self.add("Softmax", [logits]), mask])
            total = self.reduce("Sum", allowed, [1], keep=True)
            return self.add("Softmax", [self.log(self.add("RealDiv", [allowed, total]))])
        blocked = self.add("Add", [self.add("Mul", [mask, self.floats(-1)]), self.floats(1)])
        logits = self.add("Sub", [self.add("Mul", [logits, mask]), self.add("Mul", [blocked, self.floats(1e8)])])
        probs = self.add("Softmax", [logits])
        return self.add("Softmax", [self.log(probs)]) if twice else probs

    def log(self, probs: str) -> str:
        """The logarithm of p + 1e-7, which all generations before 0.26 exported."""
        return self.add("Log", [self.add("Add", [probs, self.floats(TINY)])])


def rnn_sizes(state: Weights, module: str) -> tuple[int, int, int]:
    """(hidden size, gates: 4 of an LSTM, 3 of a GRU, layers) of a recurrent module. Raises SourceError."""
    hidden = state.length(f"{module}.weight_hh_l0", 1)
    gates, rest = divmod(state.length(f"{module}.weight_hh_l0", 0), max(hidden, 1))
    if rest or gates not in (3, 4):
        raise state.unsupported_error(module, "its weights are no LSTM's and no GRU's")
    names = state.under(f"{module}.")
    if any(name.endswith("_reverse") for name in names):
        raise state.unsupported_error(
            module, "it reads its history backwards, too, and an agent has none of what comes"
        )
    return hidden, gates, sum(name.startswith("weight_hh_l") for name in names)
