"""A ``.nn`` that we wrote, run under the names of the contract that it carries.

No runtime but Unity's reads a ``.nn``: what runs it here is this project's reader and the kernels of its ops. That a
file agrees with the other formats so says that writer and reader mean the same by it, no more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from converters.compiler.passes.noise import samplers
from converters.compiler.passes.normalise import normalise
from converters.formats.barracuda.format import NnModel, parse
from converters.formats.barracuda.graph import MEMORY_IN, MEMORY_OUT, to_graph
from converters.formats.barracuda.lower import INPUT_NAMES, base_name
from converters.formats.format import Kernels
from converters.graph.jitter import Jitter
from converters.graph.nodes import Graph, Node
from converters.graph.run import run_graph
from signatures.contract import EMBEDDED, json_of, parse_signature
from signatures.errors import DamagedFileError
from signatures.fields import Field, FieldError
from signatures.roles import ACTION_NAMES, Role
from signatures.spec import PolicySignature, TensorSpec

Array = np.ndarray
Arrays = Mapping[str, Array]


def contract_of(model: NnModel) -> PolicySignature:
    """The contract that the writer left in the file. Raises DamagedFileError where there is none."""
    try:
        return parse_signature(Field(json_of(model.metadata(EMBEDDED) or "")))
    except FieldError as error:
        raise DamagedFileError(
            "the .nn carries no contract of export-model",
            why="only files of this tool say which input and output is which",
            fix="export it: export-model FILE.nn",
        ) from error


#: Outputs for which a ``.nn`` of API version 2 has no name.
_UNWRITTEN = (Role.OTHER, Role.Q_VALUES, Role.LOG_PROB, Role.STD, Role.LOG_STD)


def answered_outputs(signature: PolicySignature) -> list[str]:
    """The outputs of a policy that its ``.nn`` answers.

    A drawn class has no place in one of API version 2: ML-Agents draws it from the log-probabilities. Nor has the
    log-probability of the action that was drawn, nor a spread: Stable-Baselines3 and others give them.
    """
    scored = any(s.role is Role.LOG_PROBS for s in signature.outputs)
    unanswered = {*_UNWRITTEN, *((Role.SAMPLED,) if scored else ())}
    return [s.name for s in signature.outputs if s.role not in unanswered]


def kernels(path: Path) -> Kernels:
    """A ``.nn`` of ours, run by the numpy kernels. Raises DamagedFileError."""
    return NnPolicy(path.read_bytes()).run


class NnPolicy:
    """A ``.nn`` under canonical names."""

    def __init__(self, data: bytes) -> None:
        model = parse(data)
        self.signature = contract_of(model)
        self.graph: Graph = normalise(to_graph(model).graph)
        self._places = {n.name: n for n in self.graph.nodes if n.op == "Placeholder"}
        self._samplers = [n.name for n in samplers(self.graph)]
        #: whether the contract has the names of the file
        self._dressed = any(s.name in self._places for s in self.signature.observations if s.name.startswith("obs_"))

    def run(self, feeds: Arrays, fetch: Sequence[str], jitter: Jitter | None = None) -> dict[str, Array]:
        """Outputs by their names in the contract."""
        placed = self._place_feeds(feeds)
        specs = [self.signature.output(name) for name in fetch]
        quiet = [s for s in specs if self._is_quiet(s)]
        names = {self._tensor(s) for s in specs if s not in quiet}
        values = run_graph(self.graph, placed, sorted(names), jitter) if names else {}
        found = {s.name: self._answer(s, values[self._tensor(s)]) for s in specs if s not in quiet}
        if quiet:
            still = {
                n: np.zeros_like(a) if n in (INPUT_NAMES[Role.NOISE], *self._samplers) else a for n, a in placed.items()
            }
            still |= {n: np.zeros(self._drawn_shape(n, placed), np.float32) for n in self._samplers if n not in still}
            values = run_graph(self.graph, still, sorted({self._tensor(s) for s in quiet}), jitter)
            found |= {s.name: self._answer(s, values[self._tensor(s)]) for s in quiet}
        return found

    # ------------------------------------------------------------------ inputs

    def _place_feeds(self, feeds: Arrays) -> dict[str, Array]:
        signature = self.signature
        rows = signature.rows(feeds)
        if self._dressed:
            laid = {s.name: self._channels_last(s, feeds[s.name]) for s in signature.inputs if s.name in self._places}
            return {n: a.astype(self._places[n].attrs["dtype"]) for n, a in laid.items()}
        found: dict[str, Array] = {}
        vectors = [feeds[s.name].reshape(rows, -1) for s in signature.inputs if s.role is Role.VECTOR]
        if vectors:
            found["vector_observation"] = np.concatenate(vectors, axis=1)
        for number, spec in enumerate(s for s in signature.inputs if s.role is Role.VISUAL):
            found[f"visual_observation_{number}"] = self._channels_last(spec, feeds[spec.name])
        for role, name in INPUT_NAMES.items():
            for number, spec in enumerate(s for s in signature.inputs if s.role is role):
                given = name if number == 0 else self._samplers[number - 1]
                found[given] = feeds[spec.name].reshape(rows, -1)
        memory = signature.memory
        if memory is not None and memory.input is not None:
            found[MEMORY_IN] = feeds[memory.input].reshape(rows, -1)
        masks = INPUT_NAMES[Role.MASKS]
        if masks in self._places and masks not in found:
            found[masks] = np.ones((rows, self._width(masks)), np.float32)
        kept = {n: a.astype(self._places[n].attrs["dtype"]) for n, a in found.items() if n in self._places}
        return kept | {n: a.astype(np.float32) for n, a in found.items() if n in self._samplers}

    def _channels_last(self, spec: TensorSpec, array: Array) -> Array:
        """An input as the file has it: images with their colours last."""
        if spec.role is Role.VISUAL and self.signature.preprocess.get(spec.name, {}).get("layout") == "NCHW":
            return array.transpose(0, 2, 3, 1)
        return array

    def _width(self, name: str) -> int:
        return int(self._places[name].attrs["shape"].dims[-1])

    def _drawn_shape(self, sampler: str, placed: Arrays) -> tuple[int, ...]:
        size: Node = self.graph[sampler]
        found = run_graph(self.graph, placed, [size.inputs[0]])[size.inputs[0]]
        return tuple(int(d) for d in found)

    # ------------------------------------------------------------------ outputs

    def _discrete(self, name: str) -> bool:
        space = self.signature.action_space
        return name == "discrete_actions" or (name == "action" and space == "discrete")

    def _head(self, spec: TensorSpec) -> str:
        """The action that a companion stands beside."""
        heads = [base_name(s) for s in self.signature.outputs if base_name(s) in ACTION_NAMES]
        if spec.role is Role.LOG_PROBS or spec.dtype.startswith("int"):
            return next(h for h in heads if self._discrete(h))
        return next(h for h in heads if not self._discrete(h))

    def _is_quiet(self, spec: TensorSpec) -> bool:
        """Whether an output is the action at no noise, which has no layer of its own."""
        return (
            spec.role is Role.DETERMINISTIC and base_name(spec) not in self.graph and not spec.dtype.startswith("int")
        )

    def _tensor(self, spec: TensorSpec) -> str:
        if spec.role is Role.MEMORY_OUT:
            return MEMORY_OUT
        name = base_name(spec)
        return name if name in self.graph else self._head(spec)

    def _answer(self, spec: TensorSpec, value: Array) -> Array:
        rows = len(value)
        if spec.role is Role.DETERMINISTIC and spec.dtype.startswith("int") and not self._dressed:
            value = _best(value.reshape(rows, -1), self.signature.branches)
        elif spec.role is Role.PROBS:
            value = np.exp(value)
        shape = [rows if d is None else d for d in spec.shape]
        return value.reshape(shape).astype(spec.dtype)


def _best(scores: Array, branches: Sequence[int]) -> Array:
    """The class that scores highest, in each branch."""
    edges = np.cumsum(branches or (scores.shape[1],))[:-1]
    return np.stack([part.argmax(axis=1) for part in np.split(scores, edges, axis=1)], axis=1)
