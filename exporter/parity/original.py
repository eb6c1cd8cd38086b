"""The source itself as the reference: its own tensors, and what follows from them.

What the source has no tensor for (``deterministic_action``, ``action_log_probs``) is derived here with numpy from the
numbers that the source's runtime gave, independently of the compiler.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from converters.runner.process import LoadedModel
from signatures.roles import Role
from signatures.spec import PolicySignature, SourceMap, TensorSpec


class Original:
    """The source, loaded in a runtime that reads it by itself; answers like a policy."""

    def __init__(self, model: LoadedModel, signature: PolicySignature, source: SourceMap) -> None:
        self.model = model
        self.signature = signature
        self.source = source

    @property
    def outputs(self) -> list[str]:
        """The outputs it can answer for."""
        names = [name for name in self.source.fetches if not self._drawn(name)]
        for spec in self.signature.outputs:
            if spec.name not in names and self._derivable(spec.role):
                names.append(spec.name)
        return names

    def _drawn(self, name: str) -> bool:
        return self.signature.output(name).role is Role.SAMPLED

    def _derivable(self, role: Role) -> bool:
        action = self._action()
        if role is Role.LOG_PROBS and action.role is not Role.LOG_PROBS:
            return self._has_logits()
        if role is Role.DETERMINISTIC:
            if action.role in (Role.LOG_PROBS, Role.PROBS):
                return bool(self.signature.branches)
            return action.role is Role.CONTINUOUS or self._has_logits() or action.role is Role.DETERMINISTIC
        return False

    def _action(self) -> TensorSpec:
        return self.signature.outputs[0]

    def _has_logits(self) -> bool:
        return bool(self.source.branches) and all(b is not None for b in self.source.branches)

    def run(self, feeds: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """All ``outputs`` for one set of canonical inputs."""
        placed = self._feeds(feeds, zero_noise=False)
        fetches = {name: self.source.fetches[name] for name in self.source.fetches if not self._drawn(name)}
        logits = [b for b in self.source.branches if b is not None] if self._has_logits() else []
        values = self.model.run(placed, list(dict.fromkeys([*fetches.values(), *logits])))
        results = {name: values[tensor] for name, tensor in fetches.items()}
        parts = [values[b] for b in logits]
        for spec in self.signature.outputs:
            if spec.name in results or not self._derivable(spec.role):
                continue
            if spec.role is Role.LOG_PROBS:
                results[spec.name] = np.concatenate([_log_softmax(p) for p in parts], axis=1)
            else:
                results[spec.name] = self._deterministic(feeds, results, parts)
        return results

    def _deterministic(
        self, feeds: Mapping[str, np.ndarray], results: Mapping[str, np.ndarray], logits: list[np.ndarray]
    ) -> np.ndarray:
        action = self._action()
        if action.role is Role.CONTINUOUS:
            if not self.source.noise:
                return results[action.name]
            tensor = self.source.fetches[action.name]
            return self.model.run(self._feeds(feeds, zero_noise=True), [tensor])[tensor]
        if action.role in (Role.LOG_PROBS, Role.PROBS):
            edges = np.cumsum(self.signature.branches)[:-1]
            logits = np.split(results[action.name], edges, axis=1)
        if not logits:
            value = results[action.name].astype(np.int64)
            return value.reshape(value.shape[0], -1)
        return np.stack([np.argmax(p, axis=1) for p in logits], axis=1).astype(np.int64)

    def _feeds(self, feeds: Mapping[str, np.ndarray], *, zero_noise: bool) -> dict[str, np.ndarray]:
        batch = self.signature.rows(feeds)
        placed = {tensor: feeds[name] for name, tensor in self.source.feeds.items()}
        placed.update({name: np.asarray(value) for name, value in self.source.fixed.items()})
        placed.update({n: np.full([1] * rank, batch, np.int32) for n, rank in self.source.batch_sizes.items()})
        for tensor, dims in self.source.noise.items():
            if zero_noise or (tensor not in placed and not self.source.noise_kept):
                placed[tensor] = np.zeros([batch if d is None else d for d in dims], np.float32)
        return placed


def _log_softmax(logits: np.ndarray) -> np.ndarray:
    wide = logits.astype(np.float64)
    shifted = wide - wide.max(axis=-1, keepdims=True)
    return np.asarray(shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))).astype(np.float32)
