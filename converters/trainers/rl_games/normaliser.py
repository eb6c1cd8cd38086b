"""``RunningMeanStd`` of rl_games: clamp((x − mean) / √(variance + 1e-5), −5, 5), its statistics in float64."""

from __future__ import annotations

import math

import numpy as np

from export_model.converters.graph.nn.activations import clip
from export_model.converters.graph.types import FLOAT32
from export_model.converters.trainers.pytorch.network import Network
from export_model.converters.trainers.pytorch.weights import Weights
from export_model.converters.trainers.trainer import Saved

_EPSILON = np.float32(1e-5)
_LIMIT = 5


def observed_shape(weights: Weights, normaliser: str, saved: Saved, layer: str) -> tuple[int, ...]:
    """Return the shape of an observation: of its statistics, or (``normaliser`` empty) what ``layer`` reads.

    An image without statistics has the size that the user says, [H, W, C]. Raises SourceError, UsageError.
    """
    several = [name for name in weights.under(f"{normaliser}.{normaliser}.") if normaliser]
    if several:
        key = several[0].partition(".")[0]
        raise weights.unsupported_error(f"{normaliser}.{key[:60]}", "its observation is a dictionary")
    if normaliser:
        return weights.shape(f"{normaliser}.running_mean")
    shape = weights.shape(layer)
    if len(shape) != 4:
        return (weights.length(layer, 1),)
    channels, height, width = saved.image_shape(shape[1])
    return height, width, channels


def normalise(net: Network, x: str, module: str, shape: tuple[int, ...]) -> str:
    """Return the observation as training saw it."""
    weights = net.state
    mean, variance = (weights.array(f"{module}.running_{k}", *shape) for k in ("mean", "var"))
    weights.forget(f"{module}.count")
    net.at(module)
    with np.errstate(invalid="ignore"):  # a damaged file: verification finds it
        deviation = np.sqrt((variance + _EPSILON).astype(np.float64)).astype(FLOAT32)
    size = math.prod(shape)
    if not size:
        raise weights.damaged_error(f"{module} has no numbers", "an observation has at least one")
    centred = net.add("Sub", [x, net.const(mean, "mean")])
    return clip(net, net.add("RealDiv", [centred, net.const(deviation, "deviation")]), -_LIMIT, _LIMIT)
