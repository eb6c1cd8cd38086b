"""Tensor specs, the signature of a policy, and how its source is run."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct, field

from export_model.signatures.fields import Many, Number, Record, Shape, Text, Whole, explicit_default, one_of
from export_model.signatures.interface import Interface
from export_model.signatures.memories import SourcePart
from export_model.signatures.roles import OBSERVATIONS, Role

#: What tensors may be of.
DTYPES = (
    *("bool", "float16", "float32", "float64", "int8", "int16", "int32", "int64"),
    *("uint8", "uint16", "uint32", "uint64"),
)
Dtype = Annotated[str, one_of(DTYPES)]


class TensorSpec(Record, frozen=True):
    """One input or output.

    - ``name``: its name.
    - ``role``: what it is for.
    - ``dtype``: numpy's name.
    - ``shape``: None is a free axis; the batch comes first.
    - ``source``: its tensor in the source (``"vector_observation:0"``); several where they were joined, None where it
      was made here.
    - ``distribution``: what an input looks like.
    """

    name: Text
    role: Role
    dtype: Dtype
    shape: Shape
    source: Text | Many[Text] | None = explicit_default(lambda: None)
    distribution: Mapping[str, Any] | None = None

    def __repr__(self) -> str:
        return f"<{self.name!r}: {self.role.value}, {self.dtype} {self.shape_text}>"

    def fits(self, array: np.ndarray) -> bool:
        """Whether an array has its shape, with any number of rows."""
        return array.ndim == len(self.shape) and all(
            n in (None, m) for n, m in zip(self.shape[1:], array.shape[1:], strict=True)
        )

    @property
    def batched(self) -> bool:
        """Whether its first axis is the agents'."""
        return bool(self.shape) and self.shape[0] is None

    @property
    def shape_text(self) -> str:
        """The shape for people: ``[B, 8]``, B for the batch, ? for another axis that is free."""
        return f"[{', '.join('?B'[i == 0] if n is None else str(n) for i, n in enumerate(self.shape))}]"

    @property
    def is_sequence(self) -> bool:
        """Whether it observes several rows of numbers: a list of entities, or a history."""
        return self.role in (Role.ENTITIES, Role.VECTOR) and len(self.shape) == 3

    @property
    def is_continuous(self) -> bool:
        """Whether an action is of numbers, not of choices."""
        return self.role is Role.CONTINUOUS or (self.role is Role.DETERMINISTIC and self.dtype.startswith("float"))


class Memory(Record, frozen=True):
    """The recurrent state.

    - ``size``: floats per agent.
    - ``input``: the input that takes it.
    - ``output``: the output that gives it; None where the source has lost it.
    - ``layout``: its parts in order, such as c and h; empty where they are unknown.
    - ``others``: further pairs of input and output, of a memory in several tensors, a part of ``layout`` each.
    """

    size: Annotated[int, Meta(ge=1, le=2**31 - 1)]
    input: Text | None
    output: Text | None
    layout: Many[Text] = explicit_default(tuple)
    others: Many[tuple[Text, Text]] = ()


class ActionHead(Struct, frozen=True):
    """An action: its output, the sizes of its branches (none: it is continuous), and the same without chance."""

    spec: TensorSpec
    branches: tuple[int, ...] = ()
    plain: TensorSpec | None = None

    @property
    def name(self) -> str:
        """The output's name."""
        return self.spec.name

    @property
    def is_continuous(self) -> bool:
        """Whether it is of numbers, not of choices."""
        return self.spec.is_continuous


def _companion(head: TensorSpec, plain: Sequence[TensorSpec], heads: int) -> TensorSpec | None:
    """Of the actions without chance, the one of ``head``: by its kind, as one of two may be missing."""
    return next((s for s in plain if heads == 1 or s.is_continuous == head.is_continuous), None)


class PolicySignature(Record, frozen=True, kw_only=True):
    """The contract of a policy, the same in every format it is written to.

    - ``family``: which generation of ML-Agents, or which trainer, wrote the source.
    - ``algorithm``: PPO, SAC, POCA, BC, DQN where the graph tells it.
    - ``action_space``: continuous, discrete or hybrid.
    - ``inputs``: the policy's inputs, in order.
    - ``outputs``: the policy's outputs, in order: actions first.
    - ``memory``: the recurrent state; None where the policy has none.
    - ``branches``: number of actions of each discrete branch.
    - ``preprocess``: by input, what must be done to an image before it is fed.
    - ``constants``: what the trainer stored beside the policy.
    - ``notes``: what is to be known beside the figures, as sentences.
    - ``labels``: names that people gave to observations and actions (--labels); missing where they gave none.
    - ``interface``: what the source and the files beside it state of the numbers (docs/interface.md); missing where
      nothing does.
    """

    family: Text
    algorithm: Text | None = explicit_default(lambda: None)
    action_space: Annotated[str, one_of(("continuous", "discrete", "hybrid"))]
    inputs: Many[TensorSpec]
    outputs: Many[TensorSpec]
    memory: Memory | None = explicit_default(lambda: None)
    branches: Many[Annotated[int, Meta(ge=1, le=2**31 - 1)]] = explicit_default(tuple)
    preprocess: Mapping[str, Any] = explicit_default(dict)
    constants: Mapping[Text, Number | list[Whole]] = explicit_default(dict)
    notes: Many[Text] = explicit_default(tuple)
    labels: Mapping[str, Any] = field(default_factory=dict)
    interface: Interface | None = None

    def __repr__(self) -> str:
        return f"<PolicySignature {self.flow}: {self.family}, {self.action_space} actions>"

    @property
    def flow(self) -> str:
        """What is observed and what is done, for people: ``'state' [B, 8] → 'action' [B, 2]``."""
        return f"{_short(self.observations)} → {_short([head.spec for head in self.heads])}"

    def input(self, name: str) -> TensorSpec:
        """The input called ``name``; KeyError if there is none."""
        return _spec_named(self.inputs, name)

    def has_input(self, name: str) -> bool:
        """Whether an input is called ``name``."""
        return any(s.name == name for s in self.inputs)

    def output(self, name: str) -> TensorSpec:
        """The output called ``name``; KeyError if there is none."""
        return _spec_named(self.outputs, name)

    def rows(self, feeds: Mapping[str, np.ndarray]) -> int:
        """The batch that ``feeds`` have: a parameter's first axis may be longer, it is not free."""
        free = (s.name for s in self.inputs if s.batched)
        return next((int(feeds[name].shape[0]) for name in free), 1)

    @property
    def heads(self) -> tuple[ActionHead, ...]:
        """The actions, the first outputs: one, or the continuous and the discrete one of a hybrid policy."""
        count = 2 if self.action_space == "hybrid" else 1
        plain = [s for s in self.outputs[count:] if s.role is Role.DETERMINISTIC]
        return tuple(
            ActionHead(s, () if s.is_continuous else self.branches, _companion(s, plain, count))
            for s in self.outputs[:count]
        )

    def companion_of(self, output: str) -> TensorSpec | None:
        """The action without chance that belongs to an action, None where there is none."""
        return next((head.plain for head in self.heads if head.name == output), None)

    @property
    def recurrences(self) -> tuple[tuple[str, str], ...]:
        """(an input of the memory, the output that is fed back into it): nearly always one pair, or none."""
        memory = self.memory
        if memory is None or memory.input is None or memory.output is None:
            return ()
        return ((memory.input, memory.output), *memory.others)

    @property
    def recurrence(self) -> tuple[str, str] | None:
        """The first of ``recurrences``, the only one of a policy under its own names; None where there is none."""
        return next(iter(self.recurrences), None)

    def fed_back(self, outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """What the inputs of the memory take in the step after ``outputs``."""
        return {taken: outputs[given] for taken, given in self.recurrences}

    @property
    def log_probs(self) -> TensorSpec | None:
        """The log-probabilities of the discrete actions, None where there are none."""
        return next((s for s in self.outputs if s.role is Role.LOG_PROBS), None)

    @property
    def observations(self) -> tuple[TensorSpec, ...]:
        """Inputs that are observations."""
        return tuple(s for s in self.inputs if s.role in OBSERVATIONS)

    @property
    def noise(self) -> tuple[TensorSpec, ...]:
        """Inputs that take N(0, 1) draws."""
        return tuple(s for s in self.inputs if s.role is Role.NOISE)


def _short(specs: Sequence[TensorSpec]) -> str:
    """The first of them, and how many more there are."""
    shown = ", ".join(f"{_cut(s.name)!r} {s.shape_text}" for s in specs[:2])
    return shown + (f" and {len(specs) - 2} more" if len(specs) > 2 else "")


def _cut(name: str) -> str:
    return name if len(name) <= 30 else f"{name[:29]}…"


def _spec_named(specs: tuple[TensorSpec, ...], name: str) -> TensorSpec:
    for spec in specs:
        if spec.name == name:
            return spec
    raise KeyError(name)


class SourceMap(Record, frozen=True):
    """How to run the source itself: which of its tensors stand for the policy's inputs and outputs.

    - ``fixed``: placeholders that the policy no longer has, with the value they take.
    - ``batch_sizes``: placeholders that take the number of rows, with their rank (0, or 1 for a vector of one).
    - ``noise``: tensors that carry N(0, 1) draws, with their shapes; one that is not among ``feeds`` is fed zeros, or
      draws if ``noise_kept``.
    - ``branches``: the tensors that the draws of a sampled action are made from, in branch order (None where the
      source cannot be asked for one).
    - ``rows``: the only number of rows that the source takes, or gets right; None: any.
    - ``parts``: inputs and outputs that stand for several tensors of the source, or for one of another shape (memories
      of their own, joined to one row): they are not among ``feeds`` and ``fetches``.
    - ``fixed_rows``: those of ``fixed`` whose row is fed once for each agent.
    """

    feeds: Mapping[str, str] = field(default_factory=dict)
    fetches: Mapping[str, str] = field(default_factory=dict)
    fixed: Mapping[str, np.ndarray] = explicit_default(dict)
    batch_sizes: Mapping[Text, Annotated[int, Meta(ge=0, le=1)]] = explicit_default(dict)
    noise: Mapping[Text, Shape] = explicit_default(dict)
    noise_kept: bool = explicit_default(bool)
    branches: Many[Text | None] = explicit_default(tuple)
    rows: Annotated[int, Meta(ge=1, le=2**63 - 1)] | None = explicit_default(lambda: None)
    parts: Mapping[Text, Many[SourcePart]] = field(default_factory=dict)
    fixed_rows: Many[Text] = field(default_factory=tuple)

    def all_fetches(self) -> list[str]:
        """Every tensor of the source that it may be asked for."""
        parts = [p.tensor for given in self.parts.values() for p in given]
        return list(dict.fromkeys([*self.fetches.values(), *parts, *(b for b in self.branches if b is not None)]))

    def all_feeds(self) -> list[str]:
        """Every tensor of the source that may be fed."""
        return list(dict.fromkeys([*self.feeds.values(), *self.fixed, *self.batch_sizes, *self.noise]))

    def to_dict(self) -> dict[str, Any]:
        """What policy.json keeps of it: feeds and fetches are the ``source`` of its inputs and outputs."""
        return {key: value for key, value in super().to_dict().items() if key not in ("feeds", "fetches")}


def sources(specs: tuple[TensorSpec, ...], parts: Collection[str]) -> dict[str, str]:
    """Canonical name → the source's tensor, of those that stand for one tensor as it is."""
    return {s.name: s.source for s in specs if isinstance(s.source, str) and s.name not in parts}
