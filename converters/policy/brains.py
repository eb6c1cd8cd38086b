"""The policies of a graph: their scopes, their outputs, their constants.

Names are tried first (they are ML-Agents' own), then structure; what neither decides is an error that lists the
candidates.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.graph.nodes import Graph, Node, node_of
from export_model.converters.graph.ops.table import CONTROL_FLOW, is_fed, passes_on, traits
from export_model.converters.policy.action_values import says_action
from export_model.converters.policy.given_outputs import check_given, outputs_from_user
from export_model.converters.policy.memories import looks_like_state
from export_model.converters.policy.rules import RoleDecision, Rule
from export_model.signatures.errors import NotAPolicyError, SignatureError
from export_model.signatures.roles import (
    ACTING,
    ACTION_NAMES,
    CANONICAL,
    CONSTANT_NAMES,
    LISTED_CONSTANTS,
    OUTPUT_NAMES,
    Q_NAMES,
    Constant,
    Role,
    plain_name,
)

#: Names that inputs get; an output is called otherwise, since both may be nodes of one graph.
INPUT_NAMES = ("state", "epsilon", "action_masks", "prev_action", "recurrent_in")
_NUMBERED = re.compile(r"(state|observation|entities|epsilon)_\d+")
#: What an output is called that a policy is fed with.
_OBSERVATION = re.compile(r"(obs|observations?)(_\w+)?")
_TRAINED = ("dense", "convolution")
#: Numbers of the largest constant that a product with no trained weight has: a transform between frames is 4 × 4.
_LARGEST_FRAME = 16
#: A constant that lists sizes has no more of them.
_MAX_LISTED = 1024


class Head(Struct, frozen=True):
    """One action of a policy: its name in the source, and its canonical name (hybrid policies have two)."""

    base: str
    name: str

    @property
    def deterministic(self) -> str:
        """The name of the same action without chance."""
        return f"deterministic_{self.name}"


class GraphBrain(Struct, frozen=True):
    """One policy of a graph: its scope (``""`` or ``"GoalieBrain/"``) and where its outputs are."""

    scope: str
    #: (output's name in the source, its role, its tensor), in graph order
    outputs: tuple[tuple[str, Role, str], ...]
    constants: Mapping[str, Constant] = field(default_factory=dict)
    #: tensors that nothing reads and that could be outputs too, in a graph whose names say nothing
    left_out: tuple[str, ...] = ()
    #: output's tensor → why it has its role
    says: Mapping[str, str] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The scope without its slash."""
        return self.scope.rstrip("/")

    @property
    def heads(self) -> tuple[Head, ...]:
        """The actions. Beside ``action``, outputs called by kind are duplicates; two kinds without it are a hybrid."""
        bases = [base for base, role, _ in self.outputs if role is Role.ACTION]
        if "action" in bases:
            return (Head("action", "action"),)
        if {"continuous_actions", "discrete_actions"} <= set(bases):
            return (Head("continuous_actions", "continuous_actions"), Head("discrete_actions", "discrete_actions"))
        # where there is none, the best of the values of actions becomes it
        return (Head(bases[0] if bases else "action", "action"),)

    @property
    def canonical(self) -> dict[str, str]:
        """Output's name in the source → canonical name; duplicates of the action are left out."""
        heads = self.heads
        names = {h.base: h.name for h in heads}
        for base, role, _ in self.outputs:
            if role is Role.DETERMINISTIC:
                own = next((h for h in heads if base == f"deterministic_{h.base}"), None)
                if own is not None or base == "deterministic_action":
                    names[base] = heads[0].deterministic if own is None else own.deterministic
            elif role is not Role.ACTION:
                names[base] = CANONICAL.get(role, base)
        return names

    @property
    def roots(self) -> tuple[str, ...]:
        """The tensors that the policy computes."""
        return tuple(reference for _, _, reference in self.outputs)


#: Why a tensor is an output, where no rule decides.
_TOLD, _KNOWN, _DECLARED = "--output says so", "the format says so", "the format declares it, and no name explains it"
_BEST = "it is the only choice of the best beside the values of actions"
_BY_NAME = "its name is that of {} in ML-Agents' files and this tool's"
_ALONE = "it is the only tensor made from an observation that nothing reads"
#: Asked where the format declares outputs.
_DECLARED_ACTIONS: tuple[Rule[tuple[Graph, Node], Role], ...] = (
    Rule(Role.ACTION, lambda s: _is_choice(*s), "it is a choice, the best of some scores or drawn from them"),
    Rule(
        Role.ACTION, lambda s: says_action(s[1].name), "its name is that of an action, or of the mean or scores of one"
    ),
)
#: Which tensors may be the action, where none is called so: the one that the first of these holds for.
_ACTIONS: tuple[Rule[tuple[Graph, Node], Role], ...] = (
    Rule(
        Role.ACTION,
        lambda s: re.search(r"action|policy|^pi$|/pi$", s[1].name.lower()) is not None,
        "its name has the word of an action or a policy",
    ),
    Rule(
        Role.ACTION,
        lambda s: Q_NAMES.fullmatch(plain_name(s[1].name)) is not None,
        "its name is that of the values of actions",
    ),
)


def find_brains(
    graph: Graph,
    wanted: Mapping[str, Role] | None = None,
    declared: Mapping[str, Role | None] | None = None,
    told: Mapping[str, RoleDecision] | None = None,
) -> tuple[GraphBrain, ...]:
    """The policies in a graph, in graph order.

    ``wanted`` (source output name → role, from ``--output``) decides instead of names. ``declared`` are the outputs
    that the format names, with their roles where it knows them, and ``told`` is what its reader decided of tensors.
    Raises NotAPolicyError when there is nothing that depends on a placeholder, SignatureError when several nodes could
    be the action.
    """
    told = told or {}
    if wanted:
        return _brains_from_user(graph, wanted, declared, told)
    fed = depends_on_input(graph)
    given, says = _declared_roles(graph, declared or {}, told, fed)
    if not {*given.values()}.isdisjoint(ACTING):
        outputs = tuple((n.rsplit("/", 1)[-1], role, n) for n, role in given.items())
        scope = _scope_of(graph, [n for n, role in given.items() if role in ACTING])
        rest = [n for n in declared or () if n in fed and n not in given]
        others = _others(graph, outputs, rest, told)
        return (
            GraphBrain(scope, (*outputs, *others), _constants(graph, scope), says=says | _reasons_declared(others)),
        )
    if declared:
        fed &= set(declared)
    scopes = _scopes_with_action(graph, fed)
    return tuple(_brain(graph, scope, fed) for scope in scopes) or (
        _brain_of_sink(graph, fed, set(declared or ()), given, told),
    )


def _declared_roles(
    graph: Graph, declared: Mapping[str, Role | None], told: Mapping[str, RoleDecision], fed: set[str]
) -> tuple[dict[str, Role], dict[str, str]]:
    """Return the roles that the format knows of its outputs, and why; an argmax beside values is the action."""
    given = {n: role for n, role in declared.items() if role is not None and n in fed}
    says = {n: told[n].says if n in told and told[n].role is role else _KNOWN for n, role in given.items()}
    if Role.ACTION not in given.values() and Role.Q_VALUES in given.values():
        choices = [n for n in declared if n in fed and n not in given and _is_choice(graph, graph[n])]
        if len(choices) == 1:
            given[choices[0]], says[choices[0]] = Role.ACTION, _BEST
    values = [n for n, role in given.items() if role is Role.Q_VALUES]
    return given | dict.fromkeys(values[1:], Role.OTHER), says


def _scopes_with_action(graph: Graph, fed: set[str]) -> list[str]:
    """Return the outermost scopes that have a node called as an action is."""
    scopes: dict[str, int] = {}
    for node in graph.nodes:
        scope, _, base = node.name.rpartition("/")
        if base in ACTION_NAMES and node.name in fed and not is_fed(node):
            scopes[f"{scope}/" if scope else ""] = node.name.count("/")
    depth = min(scopes.values(), default=0)
    return [scope for scope, d in scopes.items() if d == depth]


def explain_outputs(brain: GraphBrain, told: Mapping[str, RoleDecision]) -> tuple[RoleDecision, ...]:
    """Why a brain's outputs have their roles, and what speaks against it; ``told`` is what the reader decided."""
    found = []
    for _, role, reference in brain.outputs:
        known = told.get(reference)
        against = () if known is None else known.against if known.role is role else (known.says, *known.against)
        found.append(RoleDecision(reference, role, brain.says.get(reference, _KNOWN), against))
    left = "nothing reads it, as an output, and another tensor is the action"
    return (*found, *(RoleDecision(name, None, left) for name in brain.left_out))


def _constants(graph: Graph, scope: str) -> dict[str, Constant]:
    found: dict[str, Constant] = {}
    for name in CONSTANT_NAMES:
        node = graph.get(scope + name)
        value = graph.constant(node.name) if node is not None else None
        if value is None or value.dtype.kind not in "iuf" or not np.isfinite(value).all():
            continue
        if value.size == 1:
            number = value.reshape(()).item()
            found[name] = int(number) if float(number).is_integer() else float(number)
        elif name in LISTED_CONSTANTS and 0 < value.size <= _MAX_LISTED:
            found[name] = [int(number) for number in value.reshape(-1).tolist()]
    return found


def _brain(graph: Graph, scope: str, fed: set[str]) -> GraphBrain:
    outputs, says = [], {}
    for node in graph.nodes:
        base = node.name[len(scope) :]
        named = node.name.startswith(scope) and base in OUTPUT_NAMES
        if named and node.name in fed and not is_fed(node):
            outputs.append((base, OUTPUT_NAMES[base], node.name))
            says[node.name] = _BY_NAME.format(OUTPUT_NAMES[base])
    return GraphBrain(scope, tuple(outputs), _constants(graph, scope), says=says)


def depends_on_input(graph: Graph, left_out: Callable[[Node], bool] = lambda node: False) -> set[str]:
    """Names of nodes downstream of a placeholder (parameters included), not by way of those that are ``left_out``."""
    fed: set[str] = set()
    count = -1
    loops = any(CONTROL_FLOW.get(n.op) == "next_iteration" for n in graph.nodes)
    while count != len(fed):  # a loop hands back what stands behind
        count = len(fed)
        for node in graph.nodes:
            if is_fed(node) or (not fed.isdisjoint(map(node_of, node.inputs)) and not left_out(node)):
                fed.add(node.name)
        if not loops:
            break
    return fed


def fed_through(graph: Graph, reference: str) -> str | None:
    """Return the placeholder whose elements a tensor is, computed by nothing; None where it is computed."""
    node = graph.producer(reference)
    while not is_fed(node) and passes_on(node):
        node = graph.producer(node.inputs[0])
    return node.name if is_fed(node) else None


def _shows_one_of(graph: Graph, name: str, nodes: Collection[str]) -> bool:
    """Whether a node is one of ``nodes``, or passes one of them on."""
    node = graph[name]
    while node.name not in nodes and passes_on(node) and node.inputs:
        node = graph.producer(node.inputs[0])
    return node.name in nodes


def _brains_from_user(
    graph: Graph,
    wanted: Mapping[str, Role],
    declared: Mapping[str, Role | None] | None,
    told: Mapping[str, RoleDecision],
) -> tuple[GraphBrain, ...]:
    outputs = outputs_from_user(graph, wanted)
    nodes = {node_of(reference) for _, _, reference in outputs}
    acted = {n for n, role in (declared or {}).items() if role is Role.ACTION} | {
        n.name for n in graph.nodes if n.name.rpartition("/")[2] in ACTION_NAMES and not declared
    }
    given = {role for _, role, _ in outputs}
    acted = {n for n in acted if not _shows_one_of(graph, n, nodes)}
    if Role.ACTION in given or (Role.Q_VALUES in given and not acted):
        scope = _scope_of(graph, [node_of(reference) for _, _, reference in outputs])
        says = {reference: _TOLD for _, _, reference in outputs}
        brains: tuple[GraphBrain, ...] = (GraphBrain(scope, tuple(outputs), _constants(graph, scope), says=says),)
        check_given(outputs, [role for _, role, _ in outputs], brains[0].canonical)
        return brains
    # Naming one output is enough to say that the rest is where it always is.
    named = {reference for _, _, reference in outputs}
    rest = {n: role for n, role in (declared or {}).items() if n not in named}
    brains = _give_outputs(find_brains(graph, declared=rest or declared, told=told), outputs)
    for brain in brains:
        check_given(outputs, [role for _, role, _ in brain.outputs], brain.canonical)
    return brains


def _give_outputs(brains: tuple[GraphBrain, ...], outputs: Sequence[tuple[str, Role, str]]) -> tuple[GraphBrain, ...]:
    """Return the brains with the user's outputs, each in the innermost scope around it, before their own."""
    named = {reference for _, _, reference in outputs}
    owners = [
        max((b for b in brains if o[2].startswith(b.scope)), key=lambda b: len(b.scope), default=brains[0])
        for o in outputs
    ]
    return tuple(
        replace(
            brain,
            outputs=(
                *(o for o, owner in zip(outputs, owners, strict=True) if owner is brain),
                *(o for o in brain.outputs if o[2] not in named),
            ),
            says={**brain.says, **dict.fromkeys(named, _TOLD)},
        )
        for brain in brains
    )


def _scope_of(graph: Graph, names: Sequence[str]) -> str:
    """The scope of a brain whose outputs are ``names``: the one they share, if a placeholder is in it, too."""
    parents = {name.rpartition("/")[0] for name in names}
    scope = f"{parents.pop()}/" if len(parents) == 1 else "/"
    return scope if any(is_fed(n) and n.name.startswith(scope) for n in graph.nodes) else ""


def _brain_of_sink(
    graph: Graph, fed: set[str], declared: set[str], known: Mapping[str, Role], told: Mapping[str, RoleDecision]
) -> GraphBrain:
    """A graph without a node called ``action``: the one output, or tensor that nothing reads, is the action."""
    read = {node_of(r) for node in graph.nodes for r in node.inputs} - declared
    fed = fed - set(known)
    sinks = [n for n in graph.nodes if n.name not in read and n.name in fed and not is_fed(n)]
    echoes = [n for n in sinks if fed_through(graph, n.name) is not None]
    sinks = [n for n in sinks if n not in echoes] or echoes
    if not sinks:
        raise NotAPolicyError(
            "no policy found in this graph",
            why="no node depends on a placeholder, so nothing is computed from an observation",
            fix="give the frozen graph of the policy, or name its output with --output NAME=action",
        )
    _check_acts(graph, sinks)
    chosen, why = _likely(graph, sinks, declared=bool(declared))
    if len(chosen) != 1:
        raise _ambiguous_error(sinks, chosen, why)
    node = chosen[0]
    output = (node.name.rsplit("/", 1)[-1], Role.ACTION, node.name)
    outputs = (output, *((name.rsplit("/", 1)[-1], role, name) for name, role in known.items()))
    says = {name: told[name].says if name in told else _KNOWN for name in known} | {node.name: why}
    rest = [n.name for n in (*sinks, *(e for e in echoes if e not in sinks)) if n is not node]
    if declared:
        others = _others(graph, outputs, rest, told)
        return GraphBrain("", (*outputs, *others), _constants(graph, ""), says=says | _reasons_declared(others))
    return GraphBrain("", outputs, _constants(graph, ""), tuple(rest), says)


def _ambiguous_error(sinks: Sequence[Node], chosen: Sequence[Node], why: str) -> SignatureError:
    """The error that several outputs, or none, may be the action; ``why`` is what speaks for each of ``chosen``."""
    shown = ", ".join(f"{n.name} ({n.op})" for n in sinks[:8]) + (" …" if len(sinks) > 8 else "")
    several = f"; of each of {', '.join(n.name for n in chosen[:8])}: {why}" if chosen else ""
    return SignatureError(
        "no policy found: cannot tell which output is the action",
        why=f"no node is called 'action'; candidates are {shown}{several}",
        fix="name them: --output NAME=action (and, if it has them, --output NAME=value_estimate …)",
    )


def _check_acts(graph: Graph, sinks: Sequence[Node]) -> None:
    """Raise NotAPolicyError where all that comes out is called an observation, and no trained weight is before it."""
    if not all(_OBSERVATION.fullmatch(plain_name(node.name)) for node in sinks):
        return
    upstream = graph.ancestors(node.name for node in sinks)
    weights = (r for n in graph.nodes if n.name in upstream and traits(n).layer in _TRAINED for r in n.inputs)
    if any((value := graph.constant(r)) is not None and value.size > _LARGEST_FRAME for r in weights):
        return
    shown = ", ".join(repr(node.name) for node in sinks[:4])
    raise NotAPolicyError(
        f"computes an observation, not an action: its output is {shown}",
        why="no layer in it has trained weights, so it is the part in front of a policy",
        fix=f"give the policy that is fed with it; if this is the policy all the same: --output {sinks[0].name}=action",
    )


def _likely(graph: Graph, sinks: Sequence[Node], *, declared: bool) -> tuple[list[Node], str]:
    """The tensors that may be the action, and why they may."""
    if len(sinks) == 1:
        return [*sinks], _ALONE
    for rule in (*_ACTIONS, *_DECLARED_ACTIONS) if declared else _ACTIONS:
        fitting = [n for n in sinks if rule.when((graph, n))]
        if fitting:
            return fitting, rule.says
    return [], ""


def _is_choice(graph: Graph, node: Node) -> bool:
    while passes_on(node) or node.op == "Cast":
        node = graph.producer(node.inputs[0])
    return node.op == "ArgMax" or traits(node).sampler == "categorical"


def _reasons_declared(outputs: Sequence[tuple[str, Role, str]]) -> dict[str, str]:
    return {reference: _DECLARED for _, _, reference in outputs}


def _others(
    graph: Graph, outputs: Sequence[tuple[str, Role, str]], rest: Sequence[str], told: Mapping[str, RoleDecision]
) -> list[tuple[str, Role, str]]:
    """Outputs that the format declares and no name explains: kept as they are, under names that nothing else has.

    Raises SignatureError where one looks like a memory: a policy that forgets is another policy.
    """
    taken = {*INPUT_NAMES, *CANONICAL.values(), *OUTPUT_NAMES, *(base for base, _, _ in outputs)}
    found = []
    for name in rest:
        if looks_like_state(name):
            unpaired = [d for d in told.values() if d.role is None and d.tensor in graph and is_fed(graph[d.tensor])]
            raise SignatureError(
                f"the output {name!r} looks like a memory, and it is not clear which input it is fed back to",
                why="a pair agrees in name and shape (h_in and h_out); without its memory the policy acts otherwise"
                + "".join(f"; {d.tensor}: {d.says}" for d in unpaired),
                fix=f"--input NAME=memory_in --output {name}=memory_out, or --output {name}=other if it is none",
            )
        wish = name.rsplit("/", 1)[-1]
        wish = f"output_{wish}" if wish.isdigit() or wish in taken or _NUMBERED.fullmatch(wish) else wish
        base, number = wish, 0
        while base in taken:
            number += 1
            base = f"{wish}_{number}"
        taken.add(base)
        found.append((base, Role.OTHER, name))
    return found
