"""Roles of a policy's placeholders: by what the user and the reader say, by their names, by what reads them.

``input_rules.py`` has the rules. What is not decided is a parameter, or an error that lists the candidates.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from msgspec.structs import replace

from export_model.converters.graph.nodes import Graph, Node, node_of
from export_model.converters.graph.ops.table import is_fed
from export_model.converters.policy.brains import GraphBrain
from export_model.converters.policy.given_outputs import close_names
from export_model.converters.policy.input_rules import (
    BY_NAME,
    BY_READERS,
    LAST_RESORTS,
    Read,
    ScopedInput,
    contradicted_names,
    is_board,
    is_free,
    placeholder_rank,
)
from export_model.converters.policy.rules import RoleDecision, against, first
from export_model.signatures.errors import SignatureError, UsageError
from export_model.signatures.roles import INPUT_ROLES, OBSERVATIONS, Role

#: What is said of an input that is its own.
_TOLD, _KNOWN, _DEFAULT = "--input says so", "the format says so", "it has a default value, and nothing names it"


def classify_inputs(
    graph: Graph,
    brain: GraphBrain,
    wanted: Mapping[str, Role] | None = None,
    known: Mapping[str, Role] | None = None,
    *,
    declared: bool = False,
) -> dict[str, Role]:
    """Placeholder name → role, in graph order, for everything upstream of the brain's outputs.

    ``wanted`` comes from ``--input``, ``known`` from the reader; ``declared``: the format says what its inputs are, so
    that numbers with the batch axis are observations (a graph's placeholders may be parameters of the trainer). A
    PlaceholderWithDefault that is neither named there nor by ML-Agents is left out: its default is used. Raises
    SignatureError when no observation can be told.
    """
    decisions = _Inputs(graph, brain, wanted or {}, known or {}, declared=declared).decide()
    return {d.tensor: d.role for d in decisions.values() if d.role is not None}


def explain_inputs(
    graph: Graph,
    brain: GraphBrain,
    wanted: Mapping[str, Role],
    known: Mapping[str, Role],
    told: Mapping[str, RoleDecision],
    *,
    declared: bool,
) -> tuple[RoleDecision, ...]:
    """What ``classify_inputs`` decides, why, and what speaks against it; ``told`` are the reader's own decisions."""
    inputs = _Inputs(graph, brain, wanted, known, declared=declared)
    return tuple(_with_objections(inputs, decision, told.get(decision.tensor)) for decision in inputs.decide().values())


def _with_objections(inputs: _Inputs, decision: RoleDecision, told: RoleDecision | None) -> RoleDecision:
    """A decision with what speaks against it; the reader's own sentence where it decided the same."""
    if told is None or decision.says == _TOLD:
        return replace(decision, against=inputs.against(decision))
    if told.role is decision.role:
        return told
    return replace(decision, against=(told.says, *inputs.against(decision)))


def role_by_name(base: str, node: Node) -> Role | None:
    """The role that a placeholder's name says, if its rank and dtype do not contradict it."""
    rule = first(BY_NAME, ScopedInput(base, node))
    return None if rule is None else rule.role


class _Inputs:
    """The placeholders of a brain, decided one after the other."""

    def __init__(
        self,
        graph: Graph,
        brain: GraphBrain,
        wanted: Mapping[str, Role],
        known: Mapping[str, Role],
        *,
        declared: bool,
    ) -> None:
        upstream = graph.ancestors(brain.roots)
        self.graph, self.brain, self.known, self.declared = graph, brain, known, declared
        self.found = [n for n in graph.nodes if is_fed(n) and n.name in upstream]
        inputs = {n.name for n in self.found}
        others = {n.name for n in graph.nodes if is_fed(n) and not n.name.startswith(brain.scope)} - inputs
        self.wanted = {name: role for name, role in wanted.items() if node_of(name) not in others}
        self.decisions: dict[str, RoleDecision] = {}
        self.consumers: Mapping[str, list[Node]] = {}
        self.recurrent = False

    def decide(self) -> dict[str, RoleDecision]:
        """Placeholder → what it is for."""
        for node in self.found:
            self.decisions[node.name] = self._decision_given(node)
        if self.wanted:
            name = next(iter(self.wanted))
            raise UsageError(
                f"--input names {name!r}, which is not an input of this policy",
                why=close_names(name, [n.name for n in self.found])
                or f"its inputs are {', '.join(n.name for n in self.found)}",
                fix="export-model inspect FILE lists them",
            )
        self._read()
        if not self._has_observation():
            raise self._no_observation_error()
        return self.decisions

    def against(self, decision: RoleDecision) -> tuple[str, ...]:
        """What speaks against a decision."""
        node = self.graph[decision.tensor]
        named = ScopedInput(self._base(node), node)
        said = [*against(BY_NAME, named, decision.role), *contradicted_names(named, decision.role)]
        if self.consumers and decision.role is not None:
            rules = (r for r in BY_READERS if r.role is not Role.PARAMETER)  # those tell nothing
            said += against(rules, self._read_of(node), decision.role)
        return tuple(s for s in dict.fromkeys(said) if not s.startswith(decision.says))

    def _base(self, node: Node) -> str:
        scope = self.brain.scope
        return node.name[len(scope) :] if node.name.startswith(scope) else node.name

    def _decision_given(self, node: Node) -> RoleDecision:
        """What the user, the reader or the name says of a placeholder."""
        base = self._base(node)
        override = next((self.wanted.pop(k) for k in (node.name, f"{node.name}:0", base) if k in self.wanted), None)
        if override is not None:
            if override not in INPUT_ROLES:
                raise UsageError(
                    f"--input {node.name}={override}: that is not an input's role",
                    fix=f"one of: {', '.join(INPUT_ROLES)}",
                )
            return RoleDecision(node.name, override, _TOLD)
        if node.name in self.known:
            return RoleDecision(node.name, self.known[node.name], _KNOWN)
        rule = first(BY_NAME, ScopedInput(base, node))
        if rule is not None:
            return RoleDecision(node.name, rule.role, rule.says)
        if node.op == "PlaceholderWithDefault":
            return RoleDecision(node.name, None, _DEFAULT)
        return RoleDecision(node.name, Role.PARAMETER, "")

    def _read(self) -> None:
        """Decide what names do not, from what reads it."""
        unknown = [n for n in self.found if not self.decisions[n.name].says]
        self.consumers = self.graph.consumers()
        self.recurrent = any(d.role is Role.MEMORY_IN for d in self.decisions.values())
        for node in unknown:
            rule = first(BY_READERS, self._read_of(node))
            assert rule is not None
            self.decisions[node.name] = RoleDecision(node.name, rule.role, rule.says)
        parameters = [n for n in unknown if self.decisions[n.name].role is Role.PARAMETER]
        if self._has_observation():
            free = [n for n in parameters if is_free(n)]
            if self.declared and not self.recurrent and free:
                raise self._ambiguous_error(free)
            return
        for last in LAST_RESORTS:
            fitting = [n for n in parameters if last.when(self._read_of(n))]
            if len(fitting) == 1:
                self.decisions[fitting[0].name] = RoleDecision(fitting[0].name, last.role, last.says)
            if fitting:
                return

    def _read_of(self, node: Node) -> Read:
        return Read(node, self.graph, self.consumers, self.declared, self.recurrent, self._has_observation())

    def _has_observation(self) -> bool:
        return any(d.role in OBSERVATIONS for d in self.decisions.values())

    # -------------------------------------------------------------- what cannot be told

    def _no_observation_error(self) -> SignatureError:
        names = ", ".join(f"{n.name} {_shape_text(n)}" for n in self.found) or "none"
        turned = next((n.name for n in self.found if _has_time_first(n)), None)
        if turned is not None:
            return SignatureError(
                f"the agents' axis of the input {turned!r} is its second",
                why=f"it is {names}: a history with time first; rows of a policy's inputs are agents",
                fix="export the model with the agents' axis first ([B, T, n]: batch_first=True)",
            )
        return SignatureError(
            "no policy found: cannot tell which input is an observation",
            why=f"inputs upstream of the outputs: {names}{self._reasons(self.found)}",
            fix="say what they are: --input NAME=vector_observation, --input NAME=visual_observation, --set NAME=VALUE",
        )

    def _ambiguous_error(self, nodes: Sequence[Node]) -> SignatureError:
        name = nodes[0].name
        roles = [f"--input {name}={r}" for r in ("vector_observation", "masks", "parameter")]
        known = ", ".join(roles[placeholder_rank(nodes[0]) != 2 :])
        shown = ", ".join(f"{n.name} {_shape_text(n)}" for n in nodes)
        return SignatureError(
            f"it is not clear what the input {name!r} is for",
            why=f"each agent has its own, beside an observation: {shown}{self._reasons(nodes)}",
            fix=f"say what it is: {known}, or --set {name}=VALUE",
        )

    def _reasons(self, nodes: Iterable[Node]) -> str:
        """What ``inspect --why`` would say of inputs that nothing tells."""
        said: dict[str, list[str]] = {}
        for node in nodes:
            decision = self.decisions[node.name]
            clauses = (decision.says, *contradicted_names(ScopedInput(self._base(node), node), decision.role))
            said.setdefault("; ".join(clauses), []).append(node.name)
        return "".join(f"; {', '.join(names)}: {clause}" for clause, names in said.items())


def _shape_text(node: Node) -> str:
    dims, dtype = node.dims, node.attrs.get("dtype", "")
    if dims is None:
        return f"({dtype}, unknown shape)"
    return f"({dtype} [{', '.join('?' if d is None else str(d) for d in dims)}])"


def _has_time_first(node: Node) -> bool:
    """Whether a placeholder is [T, B, n]."""
    dims = node.dims or ()
    return len(dims) == 3 and dims[1] is None and None not in (dims[0], dims[2])


__all__ = ["classify_inputs", "explain_inputs", "is_board", "placeholder_rank", "role_by_name"]
