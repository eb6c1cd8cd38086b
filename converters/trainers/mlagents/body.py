"""What stands between the sensors and the actions of ML-Agents' PyTorch networks: attention, and the hidden layers.

Source: mlagents/trainers/torch_entities/{attention,conditioning,networks}.py of 1.1.0; trainers/torch/attention.py from
0.24 on, conditioning.py from 0.26 on. Both compute the same in all of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from export_model.converters.graph.nn.activations import swish
from export_model.converters.graph.nn.linear import matmul
from export_model.converters.graph.nn.normalisation import standardise
from export_model.converters.graph.nn.reduction import over_last_axis
from export_model.converters.graph.types import FLOAT32
from export_model.converters.trainers.pytorch.network import TINY, Network
from export_model.converters.trainers.pytorch.weights import Weights

#: Of ``ResidualSelfAttention``: heads, what a forbidden score becomes, which sum of squares is no entity yet.
HEADS, FORBIDDEN, NOTHING = 4, -1e6, 0.01
_LAYER_NORM = 1e-5


# ------------------------------------------------------------------ attention over entities


def attend(net: Network, own: str | None, entities: Sequence[tuple[str, str]], encoder: str) -> str:
    """The mean of what the entities are after attention to each other, [B, embedding].

    ``own`` is what the agent observes else, ``entities`` are (module, [B, n, size]); rows of zeros are no entities.
    """
    masks, embedded = [], []
    itself = None
    if own is not None and f"{encoder}.x_self_encoder.seq_layers.0.weight" in net.state:
        itself = swish(net, net.linear(own, f"{encoder}.x_self_encoder.seq_layers.0"))
    for module, x in entities:
        net.at(module)
        count = net.length(x, 1)
        total = net.reduce("Sum", net.add("Square", [x]), [2], keep=False)
        masks.append(net.cast(net.add("Less", [total, net.floats(NOTHING)]), FLOAT32))
        if itself is not None:
            repeated = net.reshape(itself, (-1, 1, net.width(itself)))
            x = net.concat([net.add("Tile", [repeated, net.ints([1, count, 1], "times")]), x], 2)
        embedded.append(swish(net, net.linear(x, f"{module}.self_ent_encoder.seq_layers.0")))
    return _self_attention(net, net.concat(embedded, 1), net.concat(masks, 1), f"{encoder}.rsa")


def _self_attention(net: Network, x: str, mask: str, module: str) -> str:
    """``ResidualSelfAttention``: x is [B, n, embedding], the mask [B, n] 1 where there is no entity."""
    net.at(module)
    x, _, _ = standardise(net, x, [2], _LAYER_NORM)
    count, size = net.length(x, 1), net.width(x)
    if size % HEADS:
        raise net.state.damaged_error(f"its attention has {size} numbers for {HEADS} heads", "ML-Agents cannot run it")
    batch = net.shape(x)[0]

    def heads(name: str, order: Sequence[int]) -> str:
        made = net.linear(x, f"{module}.{name}", size)
        return net.transpose(net.reshape(made, (batch, count, HEADS, size // HEADS)), order)

    query, key, value = heads("fc_q", (0, 2, 1, 3)), heads("fc_k", (0, 2, 3, 1)), heads("fc_v", (0, 2, 1, 3))
    net.at(module)
    scores = net.add("RealDiv", [matmul(net, query, key), net.floats(math.sqrt(size))])
    present = net.add("Sub", [net.floats(1), mask])
    hidden = net.reshape(mask, (-1, 1, 1, count))
    seen = net.add("Mul", [net.reshape(present, (-1, 1, 1, count)), scores])
    scores = net.add("Add", [seen, net.add("Mul", [hidden, net.floats(FORBIDDEN)])])
    mixed = net.transpose(matmul(net, over_last_axis(net, "Softmax", scores), value), (0, 2, 1, 3))
    result = net.add("Add", [net.linear(net.reshape(mixed, (batch, count, size)), f"{module}.fc_out", size), x])
    net.at(f"{module}.residual_norm")
    result, _, _ = standardise(net, result, [2], _LAYER_NORM)
    shown = net.add("Mul", [result, net.reshape(present, (-1, count, 1))])
    number = net.add("Add", [net.reduce("Sum", present, [1], keep=True), net.floats(TINY)])
    return net.add("RealDiv", [net.reduce("Sum", shown, [1], keep=False), number])


# ------------------------------------------------------------------ hidden layers


def body_width(state: Weights, body: str) -> int:
    """How many numbers the first hidden layer reads. Raises DamagedFileError."""
    for first in (f"{body}.seq_layers.0", f"{body}.layers.0"):
        if f"{first}.weight" in state:
            return state.length(f"{first}.weight", -1)
        if f"{first}.hypernet.0.weight" in state:
            made = state.length(f"{first}.hypernet.{_layers_of(state, first)[-1]}.weight", 0)
            return made // max(1, state.length(f"{first}.bias", 0))
    raise state.damaged_error("its Policy has no hidden layer", f"{body}.seq_layers.0.weight is not in it")


def goal_width(state: Weights, body: str) -> int:
    """How many numbers the goals have, after which the weights are made; 0: there is none."""
    modules = [f"{body}.layers.{i}" for i in state.indices(f"{body}.layers.")]
    made = [m for m in modules if f"{m}.hypernet.0.weight" in state]
    return state.length(f"{made[0]}.hypernet.0.weight", -1) if made else 0


def hidden_layers(net: Network, x: str, goal: str | None, body: str) -> str:
    """The hidden layers, a Swish after each; with a goal the last one's weights are made from it."""
    names = "seq_layers" if net.state.indices(f"{body}.seq_layers.") else "layers"
    for index in net.state.indices(f"{body}.{names}."):
        module = f"{body}.{names}.{index}"
        if goal is not None and f"{module}.hypernet.0.weight" in net.state:
            x = swish(net, _hyper_layer(net, x, goal, module))
        else:
            x = swish(net, net.linear(x, module))
    return x


def _layers_of(state: Weights, module: str) -> list[int]:
    return state.indices(f"{module}.hypernet.")


def _hyper_layer(net: Network, x: str, goal: str, module: str) -> str:
    """``HyperNetwork``: x·W(goal) + b; W comes out of layers of its own, normalised before the last."""
    *inner, last = _layers_of(net.state, module)
    for index in inner:
        goal = swish(net, net.linear(goal, f"{module}.hypernet.{index}"))
    net.at(module)
    goal, _, _ = standardise(net, goal, [1], _LAYER_NORM)
    bias = net.state.array(f"{module}.bias", None)
    rows, columns = net.width(x), len(bias)
    weights = net.linear(goal, f"{module}.hypernet.{last}", rows * columns)
    net.at(module)
    row = net.reshape(x, (-1, 1, rows))
    product = matmul(net, row, net.reshape(weights, (-1, rows, columns)))
    return net.add("BiasAdd", [net.reshape(product, (-1, columns)), net.const(bias, "bias")])
