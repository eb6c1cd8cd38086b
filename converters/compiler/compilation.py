"""What the passes hand on, one brain on its way from the source's graph to a policy, and what a pass is."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.graph.nodes import Graph, SourceName
from export_model.converters.policy.action import ActionMeaning
from export_model.converters.policy.brains import GraphBrain
from export_model.converters.policy.facts import SourceFacts
from export_model.signatures.memories import SourcePart
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature

Dims = tuple[int | None, ...]


class Compilation(Struct, frozen=True):
    """A brain's graph, and what is known of it so far; each pass returns a new one."""

    graph: Graph
    brain: GraphBrain
    options: CompileOptions
    facts: SourceFacts
    #: the source's graph, before any placeholder got a value
    original: Graph
    #: what of the source is upstream of the brain's outputs
    source: Graph
    #: placeholder → what it is for
    roles: Mapping[str, Role]
    #: canonical output → tensor
    fetches: Mapping[str, str]
    #: canonical output → its name in the source
    sources: Mapping[str, SourceName]
    #: the source's tensors that the memory was joined from
    parts: Mapping[Role, tuple[SourcePart, ...]] = field(default_factory=dict)
    #: action → what it is
    meanings: Mapping[str, ActionMeaning] = field(default_factory=dict)
    #: sizes of a discrete action's branches
    branches: tuple[int, ...] = ()
    #: the source's tensors that a sampled action is drawn from
    branch_origins: tuple[str | None, ...] = ()
    #: whether the source's action, chance included, is a tanh
    squashed: bool = False
    #: samplers of normals that the source drew from
    draws: Mapping[str, Dims] = field(default_factory=dict)
    #: placeholders that take noise in the source
    fed: Mapping[str, Dims] = field(default_factory=dict)
    #: both, by the source's names of their tensors
    noise: Mapping[str, Dims] = field(default_factory=dict)
    signature: PolicySignature | None = None
    #: input of the signature → placeholder
    feeds: Mapping[str, str] = field(default_factory=dict)


Run = Callable[[Compilation], Compilation]
#: What contradicts it, or None.
Condition = Callable[[Compilation], str | None]


class Pass(Struct, frozen=True):
    """A step of the compiler. The conditions are not checked in an export; tests check them around every pass."""

    name: str
    run: Run
    requires: tuple[Condition, ...] = ()
    ensures: tuple[Condition, ...] = ()


def on_graph(function: Callable[[Graph], Graph]) -> Run:
    """A function from graph to graph as a step."""
    return lambda c: replace(c, graph=function(c.graph))


def on_inputs(function: Callable[[Graph, Mapping[str, Role]], Graph]) -> Run:
    """A function that asks for the placeholders' roles as a step."""
    return lambda c: replace(c, graph=function(c.graph, c.roles))


def on_tensors(function: Callable[[Graph, Mapping[str, str]], tuple[Graph, dict[str, str]]]) -> Run:
    """A function that moves the tensors that are fetched as a step."""

    def run(c: Compilation) -> Compilation:
        graph, fetches = function(c.graph, c.fetches)
        return replace(c, graph=graph, fetches=fetches)

    return run
