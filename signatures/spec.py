"""Tensor specs, the signature of a policy, and how its source is run."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from signatures.labels import parsed
from signatures.memories import SourcePart
from signatures.roles import OBSERVATIONS, Constant, Role


@dataclass(frozen=True, slots=True)
class TensorSpec:
    """One input or output.

    ``shape`` has None for a free axis (the batch comes first). ``dtype`` is numpy's name. ``source`` is the tensor of
    the source it stands for (``"vector_observation:0"``), a tuple of them where several were joined, None where it
    was made here. ``distribution`` describes what an input looks like: ``{"kind": "normal", "mean": […], "std": […]}``.
    """

    name: str
    role: Role
    dtype: str
    shape: tuple[int | None, ...]
    source: str | tuple[str, ...] | None = None
    distribution: Mapping[str, Any] | None = None

    def to_dict(self) -> dict[str, Any]:
        """As in policy.json."""
        entry: dict[str, Any] = {
            "name": self.name,
            "role": self.role.value,
            "dtype": self.dtype,
            "shape": list(self.shape),
            "source": list(self.source) if isinstance(self.source, tuple) else self.source,
        }
        if self.distribution is not None:
            entry["distribution"] = dict(self.distribution)
        return entry

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> TensorSpec:
        """The inverse of ``to_dict``."""
        source = entry.get("source")
        return cls(
            name=entry["name"],
            role=Role(entry["role"]),
            dtype=entry["dtype"],
            shape=tuple(entry["shape"]),
            source=tuple(source) if isinstance(source, list) else source,
            distribution=entry.get("distribution"),
        )


@dataclass(frozen=True, slots=True)
class Memory:
    """Recurrent state: ``size`` floats per agent, fed as ``input`` and read from ``output`` (None where the source
    has lost it). ``layout`` names its parts in order, for example ``("c", "h")``, or is empty where it is unknown.
    """

    size: int
    input: str | None
    output: str | None
    layout: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """As in policy.json."""
        return {"size": self.size, "input": self.input, "output": self.output, "layout": list(self.layout)}


@dataclass(frozen=True, slots=True)
class PolicySignature:
    """The contract of a policy, the same in every format it is written to."""

    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]
    family: str
    action_space: str  # continuous | discrete | hybrid
    branches: tuple[int, ...] = ()
    #: The training algorithm where the graph tells it: PPO, SAC, POCA, BC, DQN.
    algorithm: str | None = None
    memory: Memory | None = None
    preprocess: Mapping[str, Any] = field(default_factory=dict)
    constants: Mapping[str, Constant] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    #: Names that people gave to observations and actions (signatures/labels.py); empty where they gave none.
    labels: Mapping[str, Any] = field(default_factory=dict)

    def input(self, name: str) -> TensorSpec:
        """The input called ``name``; KeyError if there is none."""
        return _named(self.inputs, name)

    def has_input(self, name: str) -> bool:
        """Whether an input is called ``name``."""
        return any(s.name == name for s in self.inputs)

    def output(self, name: str) -> TensorSpec:
        """The output called ``name``; KeyError if there is none."""
        return _named(self.outputs, name)

    def rows(self, feeds: Mapping[str, np.ndarray]) -> int:
        """The batch that ``feeds`` have: a parameter's first axis may be longer, it is not free."""
        free = (s.name for s in self.inputs if s.shape and s.shape[0] is None)
        return next((int(feeds[name].shape[0]) for name in free), 1)

    @property
    def observations(self) -> tuple[TensorSpec, ...]:
        """Inputs that are observations."""
        return tuple(s for s in self.inputs if s.role in OBSERVATIONS)

    @property
    def noise(self) -> tuple[TensorSpec, ...]:
        """Inputs that take N(0, 1) draws."""
        return tuple(s for s in self.inputs if s.role is Role.NOISE)

    def to_dict(self) -> dict[str, Any]:
        """The part of policy.json that describes the policy (not its files)."""
        return {
            "family": self.family,
            "algorithm": self.algorithm,
            "action_space": self.action_space,
            "inputs": [s.to_dict() for s in self.inputs],
            "outputs": [s.to_dict() for s in self.outputs],
            "memory": None if self.memory is None else self.memory.to_dict(),
            "branches": list(self.branches),
            "preprocess": dict(self.preprocess),
            "constants": dict(self.constants),
            "notes": list(self.notes),
            **({"labels": dict(self.labels)} if self.labels else {}),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> PolicySignature:
        """The inverse of ``to_dict``; extra keys are ignored."""
        memory = entry.get("memory")
        return cls(
            inputs=tuple(TensorSpec.from_dict(e) for e in entry["inputs"]),
            outputs=tuple(TensorSpec.from_dict(e) for e in entry["outputs"]),
            family=entry["family"],
            action_space=entry["action_space"],
            branches=tuple(entry.get("branches", ())),
            algorithm=entry.get("algorithm"),
            memory=Memory(memory["size"], memory["input"], memory["output"], tuple(memory["layout"]))
            if memory
            else None,
            preprocess=entry.get("preprocess", {}),
            constants={str(name): _constant(value) for name, value in entry.get("constants", {}).items()},
            notes=tuple(entry.get("notes", ())),
            labels=parsed(entry.get("labels")),
        )


def _constant(value: Any) -> Constant:
    """A constant of policy.json; raises ValueError where it is none."""
    items = value if isinstance(value, list) else [value]
    if not all(isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in items):
        raise ValueError(f"the constant {value!r} is no number")
    return [int(v) for v in items] if isinstance(value, list) else items[0]


def _named(specs: tuple[TensorSpec, ...], name: str) -> TensorSpec:
    for spec in specs:
        if spec.name == name:
            return spec
    raise KeyError(name)


@dataclass(frozen=True, slots=True)
class SourceMap:
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
    """

    feeds: Mapping[str, str] = field(default_factory=dict)
    fetches: Mapping[str, str] = field(default_factory=dict)
    fixed: Mapping[str, np.ndarray] = field(default_factory=dict)
    batch_sizes: Mapping[str, int] = field(default_factory=dict)
    noise: Mapping[str, tuple[int | None, ...]] = field(default_factory=dict)
    noise_kept: bool = False
    branches: tuple[str | None, ...] = ()
    rows: int | None = None
    parts: Mapping[str, tuple[SourcePart, ...]] = field(default_factory=dict)

    def fetched(self) -> list[str]:
        """Every tensor of the source that it may be asked for."""
        parts = [p.tensor for given in self.parts.values() for p in given]
        return list(dict.fromkeys([*self.fetches.values(), *parts, *(b for b in self.branches if b is not None)]))

    def fed(self) -> list[str]:
        """Every tensor of the source that may be fed."""
        return list(dict.fromkeys([*self.feeds.values(), *self.fixed, *self.batch_sizes, *self.noise]))

    def to_dict(self) -> dict[str, Any]:
        """What policy.json keeps of it: feeds and fetches are the ``source`` of its inputs and outputs."""
        return {
            "fixed": {name: {"dtype": value.dtype.name, "value": value.tolist()} for name, value in self.fixed.items()},
            "batch_sizes": dict(self.batch_sizes),
            "noise": {name: list(shape) for name, shape in self.noise.items()},
            "noise_kept": self.noise_kept,
            "branches": list(self.branches),
            "rows": self.rows,
            **({"parts": {n: [p.to_dict() for p in parts] for n, parts in self.parts.items()}} if self.parts else {}),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any], signature: PolicySignature) -> SourceMap:
        """The inverse, with the feeds and fetches of ``signature``."""
        parts = {n: tuple(SourcePart.from_dict(p) for p in given) for n, given in entry.get("parts", {}).items()}
        return cls(
            feeds=sources(signature.inputs, parts),
            fetches=sources(signature.outputs, parts),
            fixed={n: np.array(v["value"], v["dtype"]) for n, v in entry.get("fixed", {}).items()},
            batch_sizes=dict(entry.get("batch_sizes", {})),
            noise={n: tuple(shape) for n, shape in entry.get("noise", {}).items()},
            noise_kept=bool(entry.get("noise_kept", False)),
            branches=tuple(entry.get("branches", ())),
            rows=entry.get("rows"),
            parts=parts,
        )


def sources(specs: tuple[TensorSpec, ...], parts: Collection[str]) -> dict[str, str]:
    """Canonical name → the source's tensor, of those that stand for one tensor as it is."""
    return {s.name: s.source for s in specs if isinstance(s.source, str) and s.name not in parts}
