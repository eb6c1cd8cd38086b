"""A ``.nn`` run under the names of the contract that it carries: what ``version2.dress_nn`` did, undone.

No runtime but Unity's reads a ``.nn``: what runs it here is this project's reader and the kernels of its ops. That a
file agrees with the other formats so says that writer and reader mean the same by it, no more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from export_model.converters.compiler.passes.noise import samplers
from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.consumers.mlagents.names import (
    DISCRETE,
    EPSILON,
    MASKS,
    PREVIOUS,
    RECURRENT_IN,
    RECURRENT_OUT,
    VECTOR,
)
from export_model.converters.consumers.mlagents.version2 import companions, observations
from export_model.converters.formats.barracuda.format import parse
from export_model.converters.formats.barracuda.graph import to_graph
from export_model.converters.formats.barracuda.writer import contract_of
from export_model.converters.formats.format import Kernels
from export_model.converters.graph.jitter import Jitter
from export_model.converters.graph.run import run_graph
from export_model.signatures.roles import ACTION_NAMES, Role
from export_model.signatures.spec import PolicySignature, TensorSpec

Array = np.ndarray
Arrays = Mapping[str, Array]

#: Outputs for which API version 2 has no name.
_UNWRITTEN = (Role.OTHER, Role.Q_VALUES, Role.LOG_PROB, Role.STD, Role.LOG_STD)


def answered_outputs(signature: PolicySignature) -> list[str]:
    """Return the outputs of a policy that its ``.nn`` answers.

    A drawn class has no place in one of API version 2: ML-Agents draws it from the log-probabilities. Nor has the
    log-probability of the action that was drawn, nor a spread: Stable-Baselines3 and others give them.
    """
    scored = any(s.role is Role.LOG_PROBS for s in signature.outputs)
    unanswered = {*_UNWRITTEN, *((Role.SAMPLED,) if scored else ())}
    return [s.name for s in signature.outputs if s.role not in unanswered]


def kernels(path: Path) -> Kernels:
    """Return what runs a ``.nn`` of ours by the numpy kernels. Raises DamagedFileError."""
    return NnPolicy(path.read_bytes()).run


class NnPolicy:
    """A ``.nn`` under the names of its contract, which are the policy's own or, in a profile's, the file's."""

    def __init__(self, data: bytes) -> None:
        model = parse(data)
        self.signature = contract_of(model)
        self.graph = normalise(to_graph(model).graph)
        self._places = {n.name: n for n in self.graph.nodes if n.op == "Placeholder"}
        self._samplers = [n.name for n in samplers(self.graph)]
        self._named = {s.name: name for name, s in companions(self.signature)}
        #: whether the contract has the names of the file
        self._dressed = all(s.name in self._places for s in self.signature.observations)

    def run(self, feeds: Arrays, fetch: Sequence[str], jitter: Jitter | None = None) -> dict[str, Array]:
        """Outputs by their names in the contract."""
        placed = self._place_feeds(feeds)
        specs = [self.signature.output(name) for name in fetch]
        quiet = [s for s in specs if self._is_quiet(s)]
        drawn = [s for s in specs if s not in quiet]
        found: dict[str, Array] = {}
        for wanted, fed in ((drawn, placed), (quiet, self._without_noise(placed) if quiet else placed)):
            names = {self._tensor(s) for s in wanted}
            values = run_graph(self.graph, fed, sorted(names), jitter) if names else {}
            found |= {s.name: self._answer(s, values[self._tensor(s)]) for s in wanted}
        return found

    # ------------------------------------------------------------------ inputs

    def _place_feeds(self, feeds: Arrays) -> dict[str, Array]:
        """What is fed under the names of the contract, as the file takes it; samplers are given what they drew."""
        signature = self.signature
        if self._dressed:
            found = {s.name: self._image(s, feeds[s.name]) for s in signature.inputs}
        else:
            found = self._joined(feeds)
        kept = {n: a.astype(self._places[n].attrs["dtype"]) for n, a in found.items() if n in self._places}
        return kept | {n: a.astype(np.float32) for n, a in found.items() if n in self._samplers}

    def _joined(self, feeds: Arrays) -> dict[str, Array]:
        signature, rows = self.signature, self.signature.rows(feeds)
        found: dict[str, Array] = {}
        for name, specs in observations(signature):
            if name == VECTOR:
                found[name] = np.concatenate([feeds[s.name].reshape(rows, -1) for s in specs], axis=1)
            else:
                found[name] = self._image(specs[0], feeds[specs[0].name])
        if MASKS in self._places:
            found[MASKS] = np.ones((rows, int(self._places[MASKS].attrs["shape"].dims[-1])), np.float32)
        noise = zip(signature.noise, (EPSILON, *self._samplers), strict=False)
        roles = {Role.MASKS: MASKS, Role.PREV_ACTION: PREVIOUS, Role.MEMORY_IN: RECURRENT_IN}
        named = [*((s, n) for s, n in noise), *((s, roles[s.role]) for s in signature.inputs if s.role in roles)]
        return found | {name: feeds[spec.name].reshape(rows, -1) for spec, name in named}

    def _image(self, spec: TensorSpec, array: Array) -> Array:
        """An input as the file takes it: an image with its colours last, each from 0 to 1."""
        done = self.signature.preprocess.get(spec.name, {})
        if spec.role is Role.VISUAL and done.get("layout") == "NCHW":
            array = array.transpose(0, 2, 3, 1)
        return array / np.float32(255) if done.get("range") == [0, 255] else array

    def _without_noise(self, placed: dict[str, Array]) -> dict[str, Array]:
        drawn = {n: np.zeros(self._drawn_shape(n, placed), np.float32) for n in self._samplers}
        return {**placed, **drawn, **({EPSILON: np.zeros_like(placed[EPSILON])} if EPSILON in placed else {})}

    def _drawn_shape(self, sampler: str, placed: Arrays) -> tuple[int, ...]:
        size = self.graph[sampler].inputs[0]
        return tuple(int(d) for d in run_graph(self.graph, placed, [size])[size])

    # ------------------------------------------------------------------ outputs

    def _is_quiet(self, spec: TensorSpec) -> bool:
        """Whether an output is the action at no noise, which has no layer of its own."""
        own = _plain(spec) in self.graph
        return spec.role is Role.DETERMINISTIC and not own and not spec.dtype.startswith("int")

    def _tensor(self, spec: TensorSpec) -> str:
        if spec.role is Role.MEMORY_OUT:
            return RECURRENT_OUT
        name = self._named.get(spec.name, _plain(spec))
        return name if name in self.graph else self._head(spec)

    def _head(self, spec: TensorSpec) -> str:
        """The action that a companion stands beside."""
        heads = [_plain(s) for s in self.signature.outputs if _plain(s) in ACTION_NAMES]
        discrete = spec.role is Role.LOG_PROBS or spec.dtype.startswith("int")
        only = self.signature.action_space == "discrete"
        return next(h for h in heads if (h == DISCRETE or only) == discrete)

    def _answer(self, spec: TensorSpec, value: Array) -> Array:
        rows = len(value)
        if spec.role is Role.DETERMINISTIC and spec.dtype.startswith("int") and not self._dressed:
            value = _best(value.reshape(rows, -1), self.signature.branches)
        elif spec.role is Role.PROBS:
            value = np.exp(value)
        return value.reshape([rows if d is None else d for d in spec.shape]).astype(spec.dtype)


def _plain(spec: TensorSpec) -> str:
    """An output's name without the scope of its brain, which names of the source have."""
    return spec.name.rpartition("/")[2]


def _best(scores: Array, branches: Sequence[int]) -> Array:
    """The class that scores highest, in each branch."""
    edges = np.cumsum(branches or (scores.shape[1],))[:-1]
    return np.stack([part.argmax(axis=1) for part in np.split(scores, edges, axis=1)], axis=1)
