"""Layers that the scripts share: what has no weights in them (activations, strides) follows from the scripts."""

from __future__ import annotations

import itertools

from msgspec import Struct

from export_model.converters.graph.nn.activations import Activation
from export_model.converters.graph.nn.normalisation import layer
from export_model.converters.trainers.pytorch.network import Network
from export_model.converters.trainers.trainer import Saved
from export_model.signatures.errors import UsageError
from export_model.signatures.roles import Role

#: (kernel, stride) of the convolutions before Atari's images.
_WINDOWS = ((8, 4), (4, 2), (3, 1))


class Making(Struct):
    """A policy in the making."""

    net: Network
    activation: Activation
    saved: Saved
    outputs: dict[str, Role | None]
    notes: list[str]
    memory: tuple[str, ...] = ()


def observation_input(making: Making, first: str) -> str:
    """The input that the layer ``first`` reads: numbers, or an image, whose size the user says; divided by 255."""
    net = making.net
    shape = net.state.shape(f"{first}.weight")
    if len(shape) in (1, 2):
        if making.saved.sensors and tuple(making.saved.sensors) != ((shape[-1],),):
            raise UsageError(
                "--sensors does not fit the checkpoint", why=f"it observes {shape[-1]} numbers", fix="leave it out"
            )
        return net.input("obs", shape[-1])
    size = making.saved.image_shape(net.state.length(f"{first}.weight", 1), "; CleanRL stacks four grey frames")
    making.notes.append("its image has colours from 0 to 255, which CleanRL's scripts divide by 255")
    image = net.input("obs", *size)
    net.at("obs_scaled")
    return net.nhwc(net.add("RealDiv", [image, net.floats(255)]))


def sequence(making: Making, x: str, module: str, *, ends: bool) -> str:
    """``nn.Sequential`` of convolutions, linear layers and layer norms, an activation after each but the last.

    What has no weights is told by its place: one module between two layers is the activation (before images become
    rows: Flatten alone; two are both), none is none, and more could be anything.
    """
    net, state = making.net, making.net.state
    found = state.indices(f"{module}.")
    ranks = {index: len(state.shape(f"{module}.{index}.weight")) for index in found}
    images = [index for index in found if ranks[index] == 4]
    for index, after in itertools.zip_longest(found, found[1:]):
        name = f"{module}.{index}"
        if ranks[index] == 4:
            kernel = state.length(f"{name}.weight", 2)
            place = images.index(index)
            if len(images) != len(_WINDOWS) or kernel != _WINDOWS[place][0]:
                raise state.unsupported_error(
                    name, "its strides are not in the file, and its kernels are not those of CleanRL's scripts"
                )
            x = net.convolution(x, name, _WINDOWS[place][1])
        elif ranks[index] in (1, 3):
            x = _layer_norm(net, x, name)
        else:
            x = net.linear(net.flat(x) if net.rank(x) == 4 else x, name)
        if after is None:
            return x if ends else making.activation(net, x)
        between, norms = after - index - 1, (ranks[index], ranks[after])
        flattened = net.rank(x) == 4 and ranks[after] == 2
        if between == 0 and not flattened and (1 in norms or 3 in norms):
            continue
        if between == flattened + 1:
            x = making.activation(net, x)
        elif between != 1:
            what = "nothing stands" if between == 0 else f"{between} modules without weights stand"
            raise state.unsupported_error(
                module, f"{what} between its layers {index} and {after}, and one activation is expected"
            )
    raise state.unsupported_error(module, "it has no layers")


def _layer_norm(net: Network, x: str, name: str) -> str:
    """``nn.LayerNorm``, of a row or of a whole image [C, H, W]."""
    rank, shape = net.rank(x), net.type_of(x).shape
    assert shape is not None
    sizes = [shape[i] for i in ((3, 1, 2) if rank == 4 else (1,))]
    if len(net.state.shape(f"{name}.weight")) != len(sizes):
        raise net.state.unsupported_error(
            name, "it must be a LayerNorm: what it takes together (groups, a batch) is not in the file"
        )
    scale, bias = (net.state.array(f"{name}.{part}", *map(int, sizes)) for part in ("weight", "bias"))
    if rank == 4:
        scale, bias = scale.transpose(1, 2, 0), bias.transpose(1, 2, 0)
    net.at(name)
    return layer(net, x, 1, net.const(scale, "scale"), net.const(bias, "bias"))[0]


def trunk(making: Making) -> str:
    """fc1, fc2 … of SAC, TD3 and DDPG."""
    net, x, number = making.net, observation_input(making, "fc1"), 1
    while f"fc{number}.weight" in net.state:
        x = making.activation(net, net.linear(x, f"fc{number}"))
        number += 1
    return x


def squash_to_bounds(net: Network, value: str) -> str:
    """tanh, to the bounds of the action space."""
    net.at("action")
    value = net.add("Tanh", [value])
    scale, bias = (
        net.state.array(name, *(*(1,) * (len(shape) - 1), net.width(value))[: len(shape)]).reshape(-1)
        for name in ("action_scale", "action_bias")
        for shape in (net.state.shape(name),)
    )
    return net.add("Add", [net.add("Mul", [value, net.const(scale, "scale")]), net.const(bias, "bias")])
