"""What the outputs of an ONNX model of another trainer are: by the names that trainers give, or by their order."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from msgspec import Struct

from export_model.converters.formats.onnx.reader import OnnxModel
from export_model.converters.graph.types import Dim
from export_model.converters.policy.action_values import is_q_name, is_scores
from export_model.converters.policy.rules import RoleDecision, Rule, against, first
from export_model.signatures.roles import OUTPUT_NAMES, STATE_VALUE_NAMES, Role

#: What other trainers call the action and the value: rsl_rl (actions), Stable-Baselines3, CleanRL, plain PyTorch.
_ACTION = re.compile(r"actions?|act|action_mean|mean_actions?|action_logits|logits|outputs?|mean|mu|pi|policy")
#: ... and the spread of a Gaussian action (rl_games, skrl, tianshou, CleanRL), its logarithm, the log-probability.
_STD = re.compile(r"(action_?)?(std|stddev|std_dev|sigma|scale)s?")
_LOG_STD = re.compile(r"(action_?)?log_?(std|stddev|std_dev|sigma|scale)s?")
_LOG_PROB = re.compile(r"(action_?)?log_?probs?")


class Output(Struct, frozen=True):
    """An output's node, the last part of its name in small letters, its shape, and how wide the action is."""

    node: str
    base: str
    shape: tuple[Dim, ...]
    width: tuple[Dim, ...] = ()

    @property
    def fits(self) -> bool:
        """Whether it has a number for each of the action's: [B, n], or [n] as a parameter of the network."""
        return self.shape[-1:] == self.width and self.shape[1:] in ((), self.width)

    @property
    def is_single(self) -> bool:
        """Whether it may be one number a row."""
        return len(self.shape) in (1, 2) and self.shape[1:] in ((), (1,)) and self.shape != (1,)


def _name_matches(pattern: re.Pattern[str]) -> Callable[[Output], bool]:
    return lambda o: pattern.fullmatch(o.base) is not None


def _rule_for_name(name: str, role: Role) -> Rule[Output, Role | None]:
    return Rule(role, lambda o: o.base == name, f"its name is that of {role} in ML-Agents' files and this tool's")


_Rules = tuple[Rule[Output, Role | None], ...]
#: By the name alone.
_BY_NAME: _Rules = (
    *(_rule_for_name(name, role) for name, role in OUTPUT_NAMES.items() if role is not Role.Q_VALUES),
    Rule(
        Role.VALUE,
        lambda o: STATE_VALUE_NAMES.fullmatch(o.base) is not None and o.shape[-1:] == (1,),
        "its name is that of a state's value, and it is one number a row",
    ),
    Rule(Role.ACTION, _name_matches(_ACTION), "its name is that of an action, or of the mean or the scores of one"),
    Rule(
        Role.Q_VALUES,
        lambda o: is_q_name(o.node) and len(o.shape) == 2 and o.shape[1] != 1,
        "its name is that of values of actions, and it has several a row",
    ),
    Rule(None, lambda o: is_q_name(o.node), "its name is that of values of actions, and its shape is not"),
    *(_rule_for_name(name, role) for name, role in OUTPUT_NAMES.items() if role is Role.Q_VALUES),
)
#: Which of several that are called as actions is the action: the only one that the first of these holds for.
_PLAINEST: _Rules = (
    Rule(Role.ACTION, lambda o: o.base == "action", "it alone is called action"),
    Rule(Role.ACTION, lambda o: o.base == "actions", "it alone is called actions"),
    Rule(Role.ACTION, lambda o: not is_scores(o.node), "it alone is called as an action, and not as scores"),
)
#: What belongs to an action that was told.
_BESIDE: _Rules = (
    Rule(Role.STD, lambda o: o.fits and bool(_STD.fullmatch(o.base)), "its name is that of a spread of the action"),
    Rule(
        Role.LOG_STD,
        lambda o: o.fits and bool(_LOG_STD.fullmatch(o.base)),
        "its name is that of the logarithm of a spread of the action",
    ),
    Rule(
        Role.LOG_PROB,
        lambda o: bool(_LOG_PROB.fullmatch(o.base)) and o.is_single,
        "its name is that of an action's log-probability, and it is one number a row",
    ),
)
_BY_ORDER = "it is the {} of outputs without names, as Stable-Baselines3's policies give them"
_UNNAMED = "its name is none that trainers give"


def output_roles(model: OnnxModel) -> dict[str, RoleDecision]:
    """Output node → its role, by the names that other trainers use; by position where no name says anything."""
    nodes = [*model.outputs.values()]
    if positional(model):
        places = ((Role.ACTION, "first"), (Role.VALUE, "second"), (Role.LOG_PROB, "third"))
        ordered = zip(nodes, places, strict=False)
        return {n: RoleDecision(n, role, _BY_ORDER.format(place)) for n, (role, place) in ordered}
    outputs = {n: Output(n, _base(n), tuple(model.shapes.get(n) or ())) for n in nodes}
    found = {n: _by(_BY_NAME, o) for n, o in outputs.items()}
    values = _of(found, Role.Q_VALUES)
    if len(values) > 1:
        several = "several outputs are called as values of actions"
        found |= {n: RoleDecision(n, None, several, (found[n].says,)) for n in values}
    actions = _of(found, Role.ACTION)
    if len(actions) > 1:  # beside one that is called so, a mean or logits are what it was made of
        actions = _plainest(found, [outputs[n] for n in actions])
    values = _of(found, Role.Q_VALUES)
    if not actions and len(values) == 1:
        return found
    if len(actions) != 1:  # none, or more than one: names and structure decide, or ask
        said = "several outputs are called as actions" if actions else "no output is called as an action"
        return {n: RoleDecision(n, None, said, (d.says,) if d.role else d.against) for n, d in found.items()}
    width = outputs[actions[0]].shape[1:]
    for node in [n for n, d in found.items() if d.role is None]:
        rule = first(_BESIDE, Output(node, outputs[node].base, outputs[node].shape, width))
        if rule is not None:
            found[node] = RoleDecision(node, rule.role, rule.says)
    return found


def _by(rules: _Rules, output: Output) -> RoleDecision:
    rule = first(rules, output)
    if rule is None:
        return RoleDecision(output.node, None, _UNNAMED)
    return RoleDecision(output.node, rule.role, rule.says, against(rules, output, rule.role))


def _of(found: dict[str, RoleDecision], role: Role) -> list[str]:
    return [n for n, d in found.items() if d.role is role]


def _plainest(found: dict[str, RoleDecision], outputs: Sequence[Output]) -> list[str]:
    """The action among several that are called so, which makes the others none; all where it is not plain."""
    for rule in _PLAINEST:
        fitting = [o.node for o in outputs if rule.when(o)]
        if len(fitting) == 1:
            for node in (o.node for o in outputs):
                decided = node == fitting[0]
                said = rule.says if decided else f"the action is {fitting[0]}, of which {rule.says}"
                found[node] = RoleDecision(
                    node, rule.role if decided else None, said, () if decided else (found[node].says,)
                )
            return fitting
    return [o.node for o in outputs]


def _base(node: str) -> str:
    return node.rpartition("/")[2].lower()


def positional(model: OnnxModel) -> bool:
    """Whether outputs are told by their order: Stable-Baselines3's policies return (actions, values, log_prob).

    Its recipe names none of the outputs: they are numbers, or what PyTorch calls its inner tensors.
    """
    names = list(model.outputs)
    said = [
        n for n in names if _ACTION.fullmatch(n.lower()) or n in OUTPUT_NAMES or STATE_VALUE_NAMES.fullmatch(n.lower())
    ]
    if said or len(names) not in (2, 3):
        return False
    shapes = [tuple(model.shapes.get(n) or ()) for n in model.outputs.values()]
    ranks = [len(s) for s in shapes]
    return shapes[1][-1:] == (1,) and ranks[1] == 2 and ranks[2:] in ([], [1])
