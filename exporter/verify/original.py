"""The source itself as the reference: its own tensors, and what follows from them.

What the source has no tensor for (``deterministic_action``, ``action_log_probs``) is derived here with numpy from the
numbers that the source's runtime gave, independently of the compiler. A source that takes (or gets right) one number of
rows only is run that many rows at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from export_model.converters.compiler.passes.noise import laid_out
from export_model.converters.files.children.process import LoadedModel, RunFailedError
from export_model.signatures.memories import SourcePart, join_memory, split_memory
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature, SourceMap, TensorSpec

Arrays = Mapping[str, np.ndarray]
#: Rows that a source which takes one number of them only may ask for.
MAX_ROWS = 1 << 16


class Original:
    """The source, loaded in a runtime that reads it by itself; answers like a policy."""

    def __init__(
        self,
        model: LoadedModel,
        signature: PolicySignature,
        source: SourceMap,
        then: Callable[[Arrays], dict[str, np.ndarray]] | None = None,
    ) -> None:
        """``then``: what the judge makes of each answer, where the policy computes more than its source."""
        self.model = model
        self._then = then
        self.signature = signature
        self.source = source
        if source.rows is not None and not 0 < source.rows <= MAX_ROWS:
            raise RunFailedError(
                f"the source is said to take {source.rows} rows at a time",
                why=f"no more than {MAX_ROWS} are given to a runtime",
                fix="export the policy again from its source",
            )
        #: draws that the policy makes itself, and the source is given
        self.draws = np.random.default_rng(0)
        #: the values of actions, as far as the source gives them
        self.values = next(
            (s.name for s in signature.outputs if s.role is Role.Q_VALUES and s.name in source.fetches), None
        )
        #: an action without chance → the action it belongs to
        self.plain = {head.plain.name: head.spec for head in signature.heads if head.plain is not None}

    def _derivable(self, spec: TensorSpec) -> bool:
        if spec.name in {h.name for h in self.signature.heads}:
            return self._is_best(spec)
        if spec.role is Role.LOG_PROBS:
            return self._has_logits()
        head = self.plain.get(spec.name)
        if head is None:
            return False
        if head.role in (Role.LOG_PROBS, Role.PROBS):
            return bool(self.signature.branches) and head.name in self.source.fetches
        if head.role is Role.SAMPLED:
            return self._has_logits()
        return head.name in self.source.fetches or self._is_best(head)

    def _is_best(self, head: TensorSpec) -> bool:
        """Whether an action that the source lacks is the best of the values that it has."""
        chosen = head.role is Role.DETERMINISTIC and not head.is_continuous and head.source is None
        return chosen and self.values is not None

    def _has_logits(self) -> bool:
        return bool(self.source.branches) and all(b is not None for b in self.source.branches)

    @property
    def output_names(self) -> frozenset[str]:
        """The outputs that it answers for."""
        given = {n for n in self.source.fetches if self.signature.output(n).role is not Role.SAMPLED}
        given |= {s.name for s in self.signature.outputs if s.name in self.source.parts}
        return frozenset(given | {s.name for s in self.signature.outputs if self._derivable(s)})

    def run(self, feeds: Arrays) -> dict[str, np.ndarray]:
        """Every output it can answer for, for one set of canonical inputs."""
        return self.run_all([feeds])[0]

    def run_all(self, inputs: Sequence[Arrays]) -> list[dict[str, np.ndarray]]:
        """The same for several, in few requests: a source of one row would take one for each."""
        wanted = self.source.rows
        counts = [self.signature.rows(feeds) for feeds in inputs]
        parts: list[Arrays] = []
        lengths = []
        for feeds, count in zip(inputs, counts, strict=True):
            size = count if wanted is None else wanted
            own = [feeds] if size == count else [self._some_rows(feeds, i, size) for i in range(0, count, size)]
            parts += own
            lengths.append(len(own))
        answers = iter(self._answers(parts))
        results = []
        for count, length in zip(counts, lengths, strict=True):
            first, *rest = [next(answers) for _ in range(length)]
            joint = {n: np.concatenate([a, *(r[n] for r in rest)])[:count] for n, a in first.items()}
            results.append(first if wanted in (None, count) else joint)
        return results if self._then is None else [self._then(answer) for answer in results]

    def _some_rows(self, feeds: Arrays, first: int, count: int) -> dict[str, np.ndarray]:
        """``count`` rows from ``first`` on, the last one repeated where there are not as many."""
        part = {}
        for spec in self.signature.inputs:
            array = feeds[spec.name]
            if spec.batched:
                array = array[np.minimum(np.arange(first, first + count), array.shape[0] - 1)]
            part[spec.name] = array
        return part

    def _answers(self, inputs: Sequence[Arrays]) -> list[dict[str, np.ndarray]]:
        placed = [self._feeds(feeds, zero_noise=False) for feeds in inputs]
        asked = self.source.fetches.items()
        fetches = {name: tensor for name, tensor in asked if self.signature.output(name).role is not Role.SAMPLED}
        logits = [b for b in self.source.branches if b is not None] if self._has_logits() else []
        parts = {s.name: self.source.parts[s.name] for s in self.signature.outputs if s.name in self.source.parts}
        tensors = [*fetches.values(), *(p.tensor for given in parts.values() for p in given), *logits]
        found = self.model.run_all(placed, list(dict.fromkeys(tensors)))
        return [
            self._answer(feeds, dict(values), fetches, parts, logits)
            for feeds, values in zip(inputs, found, strict=True)
        ]

    def _answer(
        self,
        feeds: Arrays,
        values: dict[str, np.ndarray],
        fetches: Mapping[str, str],
        parts: Mapping[str, Sequence[SourcePart]],
        logits: Sequence[str],
    ) -> dict[str, np.ndarray]:
        for given in parts.values():
            values.update({p.tensor: self._row(values[p.tensor], p.shape) for p in given})
        results = {n: self._row(values[tensor], self.signature.output(n).shape) for n, tensor in fetches.items()}
        results.update({name: join_memory(given, values) for name, given in parts.items()})
        scores = [self._row(values[b], (None, values[b].size)) for b in logits]
        for spec in self.signature.outputs:
            if spec.name in results or not self._derivable(spec):
                continue
            if spec.role is Role.LOG_PROBS:
                results[spec.name] = np.concatenate([_log_softmax(p) for p in scores], axis=1)
            elif spec.name not in self.plain:
                assert self.values is not None
                results[spec.name] = np.argmax(results[self.values], axis=-1).reshape(-1, 1).astype(np.int64)
            else:
                results[spec.name] = self._deterministic(self.plain[spec.name], feeds, results, scores)
        return results

    def _row(self, value: np.ndarray, shape: Sequence[int | None]) -> np.ndarray:
        """One row as the policy gives it, of a source that decides for one agent: its own tensor may have no rows."""
        dims = [1 if d is None else d for d in shape]
        alone = self.source.rows == 1 and value.ndim != len(dims) and value.size == math.prod(dims)
        return value.reshape(dims) if alone else value

    def _deterministic(
        self, head: TensorSpec, feeds: Arrays, results: Arrays, scores: Sequence[np.ndarray]
    ) -> np.ndarray:
        if head.role is Role.CONTINUOUS:
            if not self.source.noise:
                return results[head.name]
            tensor = self.source.fetches[head.name]
            return self.model.run(self._feeds(feeds, zero_noise=True), [tensor])[tensor]
        if head.role in (Role.LOG_PROBS, Role.PROBS):
            edges = np.cumsum(self.signature.branches)[:-1]
            scores = np.split(results[head.name], edges, axis=1)
        if head.role is Role.DETERMINISTIC:
            value = results[head.name].astype(np.int64)
            return value.reshape(value.shape[0], -1)
        return np.stack([np.argmax(p, axis=1) for p in scores], axis=1).astype(np.int64)

    def _feeds(self, feeds: Arrays, *, zero_noise: bool) -> dict[str, np.ndarray]:
        batch = self.signature.rows(feeds)
        placed = {tensor: feeds[name] for name, tensor in self.source.feeds.items()}
        for spec in self.signature.inputs:
            if spec.name in self.source.parts:
                placed.update(split_memory(self.source.parts[spec.name], feeds[spec.name]))
        for name, value in self.source.fixed.items():
            placed[name] = np.repeat(value, batch, axis=0) if name in self.source.fixed_rows else np.asarray(value)
        placed.update({n: np.full([1] * rank, batch, np.int32) for n, rank in self.source.batch_sizes.items()})
        for tensor, dims in self.source.noise.items():
            shape = [batch if d is None else d for d in dims]
            if zero_noise or (tensor not in placed and not self.source.noise_kept):
                placed[tensor] = np.zeros(shape, np.float32)
            elif tensor in placed:
                placed[tensor] = laid_out(placed[tensor], dims)
            else:
                placed[tensor] = self.draws.standard_normal(shape, np.float32)
        return placed


def _log_softmax(logits: np.ndarray) -> np.ndarray:
    wide = logits.astype(np.float64)
    shifted = wide - wide.max(axis=-1, keepdims=True)
    with np.errstate(divide="ignore"):
        return np.asarray(shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))).astype(np.float32)
