"""Trials of what has no layout: weights that are drawn, and policies whose numbers stand in an order by chance."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from export_model.converters.policy.policy import Policy
from export_model.exporter.layout.trial import Trial


class Network(Trial):
    """A trial of weights that are drawn, in place of a policy's."""

    def __init__(self, width: int, actions: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        sizes = (width, 128, 64, actions)
        self._weights = [rng.standard_normal(pair) / pair[0] ** 0.5 for pair in pairwise(sizes)]
        self.width, self.mean, self.deviation = width, None, None
        self.observations = rng.standard_normal((1, 256, width)).astype(np.float32) * 0.3
        acted = self.act(self.observations)
        self._acted = acted - acted.mean((0, 1))

    def act(self, observations: np.ndarray) -> np.ndarray:
        first, second, third = self._weights
        made: np.ndarray = np.tanh(np.tanh(observations @ first) @ second) @ third
        return made


class ShuffledTrial(Trial):
    """A policy's trial with the numbers of its observation and of its action in orders by chance."""

    def __init__(self, policy: Policy) -> None:
        self._seen: np.ndarray | None = None
        super().__init__(policy)
        rng = np.random.default_rng(7)
        self._seen, self._done = rng.permutation(self.width), rng.permutation(self.actions)
        if self.mean is not None and self.deviation is not None:
            places = np.argsort(self._seen)
            self.observations = self.observations[..., places]
        acted = self.act(self.observations)
        self._acted = acted - acted.mean((0, 1))

    def act(self, observations: np.ndarray) -> np.ndarray:
        if self._seen is None:
            return super().act(observations)
        acted: np.ndarray = super().act(observations[..., self._seen])[..., self._done]
        return acted
