"""The statistics of ``VecNormalize``, which Stable-Baselines3 keeps in a pickle of their own.

Source: stable_baselines3/common/vec_env/vec_normalize.py and running_mean_std.py, 0.6 to 2.9: ``obs_rms`` is one
``RunningMeanStd`` (``mean``, ``var``, ``count``), or one for each key of a Dict; ``clip_obs``, ``epsilon`` and
``norm_obs`` stand beside it; ``norm_obs_keys`` came with 1.3, before it every key was normalised. The observation
becomes clip((x − mean) / sqrt(var + epsilon), −clip_obs, clip_obs), in float64, then float32.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from msgspec import Struct, field

from export_model.converters.files.pickled_objects import Instance, array_of, unpickle_objects
from export_model.converters.graph.nn.activations import clip
from export_model.converters.graph.types import FLOAT32
from export_model.converters.trainers.pytorch.network import Network
from export_model.signatures.errors import DamagedFileError, NotAPolicyError, SourceError, naming
from export_model.signatures.roles import Role

_CLASS = "VecNormalize"
_LIBRARIES = ("stable_baselines3", "sb3_contrib")
#: The key of the one observation of a policy that has no Dict.
ALONE = "observation"
_GIVE = "give the file that VecNormalize.save wrote with this model: --normaliser FILE"
_OTHERWISE = f"{_GIVE}; or leave it out: --set normaliser=none"
#: A mean so many deviations away loses digits where it is taken off in float32; it is taken off in two parts then.
_FAR = 16.0


class Moments(Struct, frozen=True):
    """The mean and deviation of one observation, float64, in its shape; ``frames``: how many are stacked in it."""

    mean: np.ndarray
    deviation: np.ndarray
    frames: int = 1


class Normaliser(Struct):
    """A file's statistics, by the key of the observation (``ALONE`` where there is one observation).

    ``limit``: where it is clipped; ``keyed``: whether the observations are a Dict; ``applied``: what the policy's
    inputs were normalised by, by their names.
    """

    file: str
    moments: Mapping[str, Moments] = field(default_factory=dict)
    limit: float = 10.0
    keyed: bool = False
    applied: dict[str, Moments] = field(default_factory=dict)

    def check(self, keys: Collection[str] | None) -> None:
        """Raise SourceError unless the policy observes what was normalised; ``keys`` are a Dict's, else None."""
        if not self.moments:
            return
        missing = [key for key in self.moments if key not in (keys or ())]
        if self.keyed is (keys is None):
            one, several = "one observation", "a Dict of observations"
            theirs, ours = (several, one) if self.keyed else (one, several)
        elif self.keyed and missing:
            theirs, ours = ", ".join(repr(key[:40]) for key in missing[:4]), "others"
        else:
            return
        raise SourceError(
            f"{self.file} normalises {theirs}, and the policy observes {ours}",
            why="they are of different environments",
            fix=_OTHERWISE,
        )

    def apply(self, net: Network, x: str, name: str, key: str, shape: tuple[int, ...]) -> str:
        """Return the observation as the policy was trained on it. Raises SourceError where its shape is another."""
        self.applied[name] = moments = self._of_shape(key, shape)
        mean, deviation = moments.mean, moments.deviation
        high = mean.astype(FLOAT32)
        centred, width = net.add("Sub", [x, net.const(high, "mean")]), net.const(deviation.astype(FLOAT32), "deviation")
        if not (np.abs(mean) > _FAR * deviation).any():
            return clip(net, net.add("RealDiv", [centred, width]), -self.limit, self.limit)
        # Clipped between the two parts of the mean: TensorFlow folds two subtractions in a row into one constant, and
        # OpenVINO a subtraction and a factor into a product and a sum, which loses the digits again.
        rest, reach = mean - high, self.limit * deviation
        low, upper, part = (
            net.const(v.astype(FLOAT32), n)
            for v, n in ((rest - reach, "low"), (rest + reach, "high"), (rest, "rest_of_mean"))
        )
        return net.add("RealDiv", [net.add("Sub", [clip(net, centred, low, upper), part]), width])

    def _of_shape(self, key: str, shape: tuple[int, ...]) -> Moments:
        """Return the statistics of an observation of this shape.

        Those of one frame are repeated for each (VecFrameStack).
        """
        found = self.moments[key]
        own = found.mean.shape
        if own == shape:
            return found
        if len(own) == len(shape) == 1 and own[0] and shape[0] % own[0] == 0:
            frames = shape[0] // own[0]
            return Moments(np.tile(found.mean, frames), np.tile(found.deviation, frames), frames)
        raise SourceError(
            f"{self.file} has statistics of the shape {list(own)}, and the policy's {key[:40]} has {list(shape)}",
            why="they are of another environment, or a wrapper between the two changes the observation",
            fix=_OTHERWISE,
        )

    def distributions(self, roles: Mapping[str, Role]) -> dict[str, dict[str, Any]]:
        """Return what the inputs are fed: a camera's bytes as they are, numbers around the mean."""
        made: dict[str, dict[str, Any]] = {}
        for name, moments in self.applied.items():
            if roles[name] is Role.VISUAL:
                made[name] = {"kind": "uniform", "low": 0.0, "high": 255.0}
                continue
            flat = moments.mean.ndim == 1
            mean, std = (a if flat else a.mean(keepdims=True).reshape(1) for a in (moments.mean, moments.deviation))
            made[name] = {"kind": "normal", "mean": mean.tolist(), "std": std.tolist(), "clip": self.limit}
        return made

    def notes(self) -> list[str]:
        """Return what a user should know."""
        if not self.moments:
            return [f"{self.file} normalises no observation (norm_obs): they are fed as they are"]
        named = f" ({', '.join(self.applied)})" if self.keyed else ""
        stacked = [
            f"{name} is {moments.frames} frames in a row: fill those before the first with the normaliser's mean, "
            "where VecFrameStack has zeros behind VecNormalize"
            for name, moments in self.applied.items()
            if moments.frames > 1
        ]
        return [
            f"observations{named} are normalised inside, by the statistics in {self.file} (VecNormalize), and clipped "
            f"to ±{self.limit:g}: feed them as the environment gives them",
            *stacked,
        ]


def read_normaliser(name: str, data: bytes) -> Normaliser:
    """Return what a pickled ``VecNormalize`` says. Raises NotAPolicyError for another pickle, DamagedFileError."""
    with naming(name):
        value = unpickle_objects(data)
    if not isinstance(value, Instance) or not _is_vecnormalize(value):
        what = f"an object of {value.maker.module[:60]}.{value.maker.name[:60]}" if isinstance(value, Instance) else ""
        raise NotAPolicyError(
            f"{name} is not a VecNormalize of Stable-Baselines3",
            why=f"it holds {what or f'a {type(value).__name__}'}",
            fix=_OTHERWISE,
        )
    limit, epsilon = (_positive(value, *known) for known in (("clip_obs", 10.0), ("epsilon", 1e-8)))
    moments = value.attribute("obs_rms")
    if value.attribute("norm_obs", True) is not True or moments is None:
        return Normaliser(name)
    if not isinstance(moments, dict):
        return Normaliser(name, {ALONE: _moments(moments, "obs_rms", epsilon)}, limit)
    keys = value.attribute("norm_obs_keys")
    keys = list(moments) if keys is None else keys
    if not isinstance(keys, list) or not all(isinstance(key, str) and key in moments for key in keys):
        raise DamagedFileError(
            f"{name} normalises observations that it has no statistics of", why="norm_obs_keys says which", fix=_GIVE
        )
    return Normaliser(name, {key: _moments(moments[key], f"obs_rms[{key!r}]", epsilon) for key in keys}, limit, True)


def _is_vecnormalize(value: Instance) -> bool:
    return value.maker.name == _CLASS and value.maker.module.partition(".")[0] in _LIBRARIES


def _positive(value: Instance, name: str, default: float) -> float:
    number = float(array_of(value.attribute(name, default), name).reshape(-1)[:1].sum())
    if not (math.isfinite(number) and number > 0):
        raise DamagedFileError(f"its {name} is {number}", why="a positive number is expected", fix=_GIVE)
    return number


def _moments(value: Any, what: str, epsilon: float) -> Moments:
    if not isinstance(value, Instance):
        raise DamagedFileError(f"its {what} is not a RunningMeanStd", why="VecNormalize keeps one", fix=_GIVE)
    mean, variance = (array_of(value.attribute(k), f"{what}.{k}").astype(np.float64) for k in ("mean", "var"))
    if mean.shape != variance.shape or not (np.isfinite(mean).all() and np.isfinite(variance).all()):
        raise DamagedFileError(f"the mean and variance of its {what} do not fit together", fix=_GIVE)
    if (variance < 0).any():
        raise DamagedFileError(f"the variance of its {what} is negative", fix=_GIVE)
    return Moments(mean, np.sqrt(variance + epsilon))
