"""Layers that sb3-contrib alone has: sb3_contrib/common/torch_layers.py."""

from __future__ import annotations

import numpy as np

from export_model.converters.graph.nn.activations import Activation
from export_model.converters.graph.nn.normalisation import batch
from export_model.converters.trainers.pytorch.network import Network


def renormalised_mlp(net: Network, x: str, module: str, activation: Activation, epsilon: float) -> str:
    """CrossQ's ``latent_pi``: a ``BatchRenorm1d`` before each linear layer and behind the last activation.

    Without them (``batch_norm=False``, and SAC's) it is ``Network.mlp``. Raises SourceError, DamagedFileError.
    """
    found = net.state.indices(f"{module}.")
    norms = [i for i in found if f"{module}.{i}.ra_mean" in net.state]
    if not norms:
        return net.mlp(x, module, activation)
    if norms != list(range(0, 3 * len(norms), 3)) or found != sorted([*norms, *(i + 1 for i in norms[:-1])]):
        raise net.state.unsupported_error(
            f"{module} (with weights at {', '.join(map(str, found[:8]))})",
            "a batch renormalisation, a linear layer and an activation by turns are expected",
        )
    for index in norms:
        x = _batch_renorm(net, x, f"{module}.{index}", epsilon)
        if index != norms[-1]:
            x = activation(net, net.linear(x, f"{module}.{index + 1}"))
    return x


def _batch_renorm(net: Network, x: str, module: str, epsilon: float) -> str:
    """``BatchRenorm1d`` as ``predict`` runs it: by its running statistics, whatever its warm-up had reached."""
    net.at(module)
    scale, bias, mean, variance = (
        net.state.array(f"{module}.{name}", net.width(x)) for name in ("scale", "bias", "ra_mean", "ra_var")
    )
    net.state.forget(f"{module}.steps")
    with np.errstate(all="ignore"):  # a damaged file: verification finds it
        return batch(net, x, scale=scale, bias=bias, mean=mean, variance=variance, epsilon=epsilon)
