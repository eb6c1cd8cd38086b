"""Values of actions (Q-values): what tells them from a continuous action, and the value of a state from either.

A value network of a discrete game gives a number per action, and the game takes the largest; a continuous policy of as
many actions looks the same. ``EVIDENCE`` is what tells them apart; where none of it holds, a note names the flag.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from msgspec import Struct

from export_model.converters.graph.nodes import Graph, Node, normal_ref
from export_model.converters.graph.ops.table import passes_on, traits
from export_model.signatures.roles import Q_NAMES, STATE_VALUE_NAMES, plain_name

#: Names that say that an output is the action itself, or scores that are drawn from.
_ACTION_NAMES = re.compile(
    r"(.*_)?(actions?|act|actor|mean|mu|pi|policy|controls?|steering|throttle|logits|probs?)(_.*)?"
)
_SCORES = re.compile(r"(action_)?logits")
#: Names of networks, and of the last layers of networks, that value actions …
_Q_NETWORKS = re.compile(
    r"(.*_)?(d+qn|dueling|q_?net(work)?|q_?func(tion)?|deep_?q|q_?values?|categorical_?q(_?network)?)(_.*)?"
)
#: … and that value states.
_STATE_NETWORKS = re.compile(r"(.*_)?(critic|value_?(net(work)?|function|model))(_.*)?")
#: Losses of a regression, as Keras and TensorFlow.js name them; own ones of tutorials are called ``_huber_loss``.
_REGRESSION = re.compile(
    r"_*(.*_)?(mse|mae|mean_?squared_?error|mean_?absolute_?error|huber(_?loss)?|log_?cosh|smooth_?l1(_?loss)?)"
)
#: Ends of a network that a value is never squashed by.
_BOUNDED = frozenset(("sigmoid", "tanh", "softmax", "softsign", "relu 6"))
_MOST_STEPS = 32


class OutputCandidate(Struct, frozen=True):
    """An output that may be a continuous action or values of actions.

    ``graph`` is normalised and folded, ``tensor`` its tensor; ``name`` is what the source calls it, ``layer`` the names
    of the nodes and weights of the layer that makes it, ``model`` and ``loss`` what the format says of the model.
    """

    graph: Graph
    tensor: str
    name: str
    layer: tuple[str, ...] = ()
    model: str = ""
    loss: str = ""


class Evidence(Struct, frozen=True):
    """A sign that an output values actions: ``said`` completes "since", ``seen`` says who writes such files."""

    said: str
    seen: str
    holds: Callable[[OutputCandidate], bool]


def _has_q_name(given: OutputCandidate) -> bool:
    return is_q_name(given.name)


def _made_by_q_network(given: OutputCandidate) -> bool:
    words = (word for name in (given.model, *given.layer) for word in re.split(r"[/.:]", name))
    return any(_Q_NETWORKS.fullmatch(plain_name(word)) for word in words)


def _dueling(given: OutputCandidate) -> bool:
    terms = _summands(given.graph, given.tensor)
    added = {ref for ref, sign in terms if sign > 0}
    for reference, sign in terms:
        node = given.graph.producer(reference)
        mean = not traits(node).elementwise and traits(node).takes in ("mean", "largest") and sign < 0
        if mean and _through(given.graph, node.inputs[0]) in added and len(added) > 1:
            return True
    return False


def _trained_by_regression(given: OutputCandidate) -> bool:
    return _REGRESSION.fullmatch(plain_name(given.loss)) is not None and _is_linear(given.graph, given.tensor)


EVIDENCE = (
    Evidence(
        "its name says so", "CleanRL (dqn.py, pqn.py: q_values), Keras and TensorFlow.js games (q, Q)", _has_q_name
    ),
    Evidence(
        "the network that makes it is named as one",
        "Stable-Baselines3 (dqn/policies.py: q_net.q_net.4.weight), TF-Agents (QNetwork/…), OpenAI Baselines "
        "(deepq/q_func/…), Keras models called dqn",
        _made_by_q_network,
    ),
    Evidence("it is a dueling head, V + A - mean A", "Wang et al. 2016, equation 9, and whoever follows it", _dueling),
    Evidence(
        "it is linear, and the model was compiled with the loss of a regression",
        "Keras and TensorFlow.js tutorials of DQN: compile(loss='mse') or Huber, kept as training_config; actors of "
        "DDPG and the like end in tanh, and are trained by no loss of Keras",
        _trained_by_regression,
    ),
)


def is_scores(name: str) -> bool:
    """Whether an output is called as scores of a choice."""
    return _SCORES.fullmatch(plain_name(name)) is not None


def is_q_name(name: str) -> bool:
    """Whether an output's name says that it holds values of actions."""
    return Q_NAMES.fullmatch(plain_name(name)) is not None


def evidence_of(given: OutputCandidate) -> Evidence | None:
    """The first sign that an output values actions; None: it may be a continuous action as well."""
    return next((e for e in EVIDENCE if e.holds(given)), None)


def says_action(name: str) -> bool:
    """Whether an output's name says that it is the action, or scores that one is drawn by."""
    return _ACTION_NAMES.fullmatch(plain_name(name)) is not None


def is_state_value(given: OutputCandidate) -> bool:
    """Whether an output of one number a row is called a value (of a state, or of a given action), or its weights are.

    An actor's layer may be called so in part (``actor_critic.actor``): the output's name or the layer's decides then.
    """
    name, model = plain_name(given.name), plain_name(given.model)
    named = STATE_VALUE_NAMES.fullmatch(name) or Q_NAMES.fullmatch(name)
    parts = {plain_name(part) for text in given.layer for part in re.split("[./]", text) if len(part) > 1}
    acts = any(map(_ACTION_NAMES.fullmatch, (name, *parts)))
    return bool(
        named or _STATE_NETWORKS.fullmatch(model) or (any(map(STATE_VALUE_NAMES.fullmatch, parts)) and not acts)
    )


def may_be_values(graph: Graph, tensor: str) -> bool:
    """Whether a float tensor is neither drawn nor bounded nor probabilities: values are none of it."""
    upstream = graph.ancestors([tensor])
    drawn = any(traits(n).sampler for n in graph.nodes if n.name in upstream)
    return not drawn and not _is_bounded(graph, tensor)


def _is_bounded(graph: Graph, tensor: str) -> bool:
    """Whether a tensor is squashed or clipped, perhaps scaled and moved after that."""
    for _ in range(_MOST_STEPS):
        node = graph.producer(tensor)
        if traits(node).activation in _BOUNDED or (traits(node).elementwise and traits(node).takes):
            return True
        constants = [graph.constant(r) is not None for r in node.inputs]
        if passes_on(node):
            tensor = node.inputs[0]
        elif traits(node).operand and len(constants) == 2 and any(constants) and not all(constants):
            tensor = node.inputs[constants.index(False)]
        else:
            return False
    return False


def _is_linear(graph: Graph, tensor: str) -> bool:
    """Whether a tensor is a matrix product, perhaps with a bias."""
    return any(traits(n).layer == "dense" for n in _affine(graph, tensor))


def _affine(graph: Graph, tensor: str) -> list[Node]:
    """The nodes from a tensor back to the product that it is of; nothing where something else makes it."""
    nodes: list[Node] = []
    for _ in range(_MOST_STEPS):
        node = graph.producer(tensor)
        nodes.append(node)
        if traits(node).layer == "dense":
            return nodes
        biased = traits(node).operand == "summand" or traits(node).name == "BiasAdd"
        moving = [r for r in node.inputs if graph.constant(r) is None]
        if not (passes_on(node) or biased) or not (moving if biased else node.inputs):
            return []
        tensor = (moving if biased else node.inputs)[0]
    return []


def last_layer(graph: Graph, tensor: str) -> tuple[str, ...]:
    """The names of the last layer's nodes and weights, in a graph as its source has it."""
    nodes = _affine(graph, tensor)
    weights = [graph.producer(r) for n in nodes for r in n.inputs if graph.constant(r) is not None]
    return tuple(text for n in (*nodes, *weights) for text in (n.name, n.origin) if isinstance(text, str))


def _through(graph: Graph, reference: str) -> str:
    """The tensor that one passes on."""
    node = graph.producer(reference)
    while passes_on(node):
        reference = node.inputs[0]
        node = graph.producer(reference)
    return normal_ref(reference)


def _summands(graph: Graph, tensor: str) -> list[tuple[str, int]]:
    """The tensors that one is the sum of, with their signs."""
    found: list[tuple[str, int]] = []
    stack = [(_through(graph, tensor), 1)]
    for _ in range(_MOST_STEPS):
        if not stack:
            break
        reference, sign = stack.pop()
        node = graph.producer(reference)
        kind = traits(node).operand
        if kind in ("summand", "subtrahend") and not any(graph.constant(r) is not None for r in node.inputs):
            second = sign if kind == "summand" else -sign
            stack += [(_through(graph, node.inputs[0]), sign), (_through(graph, node.inputs[1]), second)]
        else:
            found.append((reference, sign))
    return found
