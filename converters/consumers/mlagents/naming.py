"""A policy taken over into a consumer's names: new inputs in front of its graph, new outputs behind it.

The graph itself stays as it is. In front of it each input of the consumer is brought to what the graph takes (an image
turned, a float cast, a row of memory reshaped); behind it the actions are brought to what the consumer reads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence, Set
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.compiler.passes.fold import fold
from export_model.converters.compiler.passes.naming import name_tensors
from export_model.converters.compiler.passes.signature import LIFTED
from export_model.converters.compiler.passes.simplify import collapse_views, drop_identities
from export_model.converters.compiler.passes.transposes import cancel_transposes
from export_model.converters.consumers.profile import raise_profile_error
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nodes import Graph, NameScope, Node, ref, split_ref
from export_model.converters.graph.types import FLOAT32, static_shape
from export_model.converters.policy.policy import Policy
from export_model.signatures.interface import Interface
from export_model.signatures.roles import Role
from export_model.signatures.spec import Memory, SourceMap, TensorSpec


class Dressing(Struct, dict=True):
    """A policy on its way into the names of ``profile``.

    ``tensors`` maps the policy's own inputs, later its own outputs too, to tensors of the new graph.
    """

    policy: Policy
    profile: str
    inputs: list[TensorSpec] = field(default_factory=list)
    outputs: list[TensorSpec] = field(default_factory=list)
    tensors: dict[str, str] = field(default_factory=dict)
    feeds: dict[str, str] = field(default_factory=dict)
    fetches: dict[str, str] = field(default_factory=dict)
    constants: dict[str, np.ndarray] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    branches: tuple[int, ...] = ()
    #: input → what is done to a camera's image before it is fed
    images: dict[str, object] = field(default_factory=dict)
    #: memories that the consumer's runtime carries by itself: input → output
    kept: dict[str, str] = field(default_factory=dict)
    #: what is taken from the scores of a forbidden action; by default as the torch exporter does it (0.22 on)
    forbidden: float = 1e8

    @cached_property
    def builder(self) -> Builder:
        """Builds the new graph, under names that the policy's own does not have."""
        return Builder(NameScope(n.name for n in self.policy.graph.nodes))

    def refuse(self, what: str, *, why: str, fix: str) -> NoReturn:
        """Raise the ProfileError of what this profile cannot hold."""
        raise_profile_error(self.policy, self.profile, what, why=why, fix=fix)

    # ------------------------------------------------------------------ in front of the graph

    def take(self, name: str, spec: TensorSpec, shape: tuple[int | None, ...], dtype: np.dtype[Any] = FLOAT32) -> str:
        """A new input of the consumer that stands for the policy's input ``spec``."""
        origin = spec.source if isinstance(spec.source, str) else None
        made = self.builder.named_input(self.builder.names.fresh(f"{self.profile}/{name}"), dtype, shape, origin)
        self.feeds[name] = made
        self.inputs.append(replace(spec, name=name, dtype=dtype.name, shape=shape))
        return made

    def give_in(self, spec: TensorSpec, tensor: str) -> None:
        """Let ``tensor`` be what the graph takes as its input ``spec``: cast and reshaped to it."""
        tensor = self.builder.cast(tensor, np.dtype(spec.dtype))
        if self.builder.rank(tensor) != len(spec.shape):
            dims = [-1 if d is None else d for d in spec.shape]
            tensor = self.builder.add("Reshape", [tensor, self.builder.ints(dims, "shape")], f"{spec.name}/as_taken")
        self.tensors[self.policy.feeds[spec.name]] = tensor

    def take_over(self, draws: Callable[[TensorSpec], str] | None) -> None:
        """Append the policy's graph behind the inputs.

        ``draws`` makes what stands for an input of noise (None: zeros, where no draw is wanted). What does not hang on
        noise comes first, so that a draw can be of the shape of something computed.
        """
        graph = self.policy.graph
        noise = {self.policy.feeds[s.name]: s for s in self.policy.signature.noise}
        noise = {placeholder: spec for placeholder, spec in noise.items() if placeholder not in self.tensors}
        if draws is not None:
            self.notes.extend(f"{spec.name} is drawn inside the model, new at every step" for spec in noise.values())
        behind: set[str] = set(noise)
        later = []
        for node in graph.nodes:
            if node.op == "Placeholder":
                continue
            if behind.intersection(split_ref(r)[0] for r in node.inputs):
                behind.add(node.name)
                later.append(node)
            else:
                self._keep(node)
        for placeholder, spec in noise.items():
            zeros = np.zeros([d or 1 for d in spec.shape], np.float32)
            self.tensors[placeholder] = self.builder.floats(zeros, spec.name) if draws is None else draws(spec)
        for node in later:
            self._keep(node)

    def _keep(self, node: Node) -> None:
        self.builder.append(node.with_inputs(self.current_reference(r) for r in node.inputs))

    def current_reference(self, reference: str) -> str:
        """Where a tensor of the policy's graph is now."""
        name, index = split_ref(reference)
        return self.tensors.get(ref(name, index), reference)

    def own(self, output: str) -> str:
        """The tensor that is the policy's output of this name."""
        return self.current_reference(self.policy.fetches[output])

    # ------------------------------------------------------------------ behind it

    def give(self, name: str, tensor: str, role: Role, source: str | tuple[str, ...] | None = None) -> None:
        """Let ``tensor`` be an output of the consumer's."""
        pinned = self.builder.add("Identity", [tensor], f"{self.profile}/{name}")
        kind = self.builder.type_of(tensor)
        self.fetches[name] = pinned
        self.outputs.append(TensorSpec(name, role, kind.dtype.name, static_shape(kind.shape) or (None,), source))

    def finish(self, memory: Memory | None, beside: Sequence[Node] = (), *, unread: bool = False) -> Policy:
        """The policy in the consumer's names; ``beside`` are nodes that nothing reads and the consumer looks up.

        ``unread``: inputs that nothing reads stay, as the consumer looks for them (masks of a single action).
        """
        made = self.builder.graph()
        graph = made.prune(self.fetches.values())
        work, fetches = drop_identities(fold(graph).prune(self.fetches.values()), self.fetches)
        work, fetches = cancel_transposes(*collapse_views(work, fetches))
        if unread:
            work = Graph((*(made[node] for node in self.feeds.values() if node not in work), *work.nodes))
        feeds = {name: node for name, node in self.feeds.items() if node in work}
        work = name_tensors(work, feeds, fetches, (*self.constants, *(n.name for n in beside)))
        signature = replace(
            self.policy.signature,
            inputs=tuple(s for s in self.inputs if s.name in feeds),
            outputs=tuple(self.outputs),
            memory=memory,
            branches=self.branches,
            preprocess=self.images,
            constants={
                **{n.name: _plain(n.value) for n in beside if n.value is not None},
                **{k: _plain(v) for k, v in self.constants.items()},
            },
            notes=(*(n for n in self.policy.signature.notes if not LIFTED.fullmatch(n)), *self.notes),
            labels={},
            interface=_interface_of(self.policy.signature.interface, {s.name for s in self.inputs if s.name in feeds}),
        )
        names = [s.name for s in signature.inputs], [s.name for s in signature.outputs]
        drawn = {s.name: s.shape for s in self.policy.signature.noise[len(signature.noise) :]}  # the first are taken
        return Policy(
            name=self.policy.name,
            graph=Graph((*work.nodes, *beside)),
            signature=signature,
            feeds={n: n for n in names[0]},
            fetches={n: n for n in names[1]},
            source=SourceMap(
                noise=drawn,
                noise_kept=bool(drawn),
            ),
            constants=dict(self.constants),
            kept=dict(self.kept),
        )


def _interface_of(interface: Interface | None, inputs: Set[str]) -> Interface | None:
    """What is stated of the inputs that keep their names; the rest of it as it is."""
    if interface is None:
        return None
    return replace(interface, observations={n: t for n, t in interface.observations.items() if n in inputs})


def _plain(value: np.ndarray) -> int | list[int]:
    numbers = [int(v) for v in value.reshape(-1)]
    return numbers if value.ndim > 1 else numbers[0]


def row(builder: Builder, tensor: str, width: int) -> str:
    """A tensor as [B, width]."""
    if builder.shape(tensor)[1:] == (width,):
        return tensor
    return builder.add("Reshape", [tensor, builder.ints([-1, width], "row")])
