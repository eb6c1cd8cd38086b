"""Activations: by the names that PyTorch's classes and the trainers' configurations give them; which one a policy has.

Formulas and defaults: torch/nn/modules/activation.py. ``elu`` and ``ELU`` are one. ``lrelu`` and ``crelu`` (CELU) are
rsl_rl's (rsl_rl/utils/utils.py). No state dictionary has the activation: it is the user's word, or what the trainer
wrote beside the checkpoint, or what the one script of a trainer has. Isaac Lab writes ``params/agent.yaml`` into a
run's folder, where rsl_rl's ``model_<n>.pt`` lie. Of that file the lines ``key: value`` are read by their indentation:
the base install has no PyYAML, which ``files/yaml_data.py`` needs for trainers that ask more of it.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from export_model.converters.files.fetch import Fetched
from export_model.converters.graph.nn.activations import (
    NAMED,
    Activation,
    celu,
    clip,
    hard_sigmoid,
    hard_swish,
    leaky_relu,
    log_sigmoid,
)
from export_model.signatures.errors import SourceError, UsageError

LEAKY_SLOPE = 0.01
_KNOWN: dict[str, Activation] = {
    **NAMED,
    "crelu": celu,
    "leakyrelu": partial(leaky_relu, alpha=LEAKY_SLOPE),
    "lrelu": partial(leaky_relu, alpha=LEAKY_SLOPE),
    "relu6": partial(clip, low=0, high=6),
    "hardtanh": partial(clip, low=-1, high=1),
    "hardsigmoid": partial(hard_sigmoid, alpha=1 / 6, beta=0.5),
    "hardswish": hard_swish,
    "logsigmoid": log_sigmoid,
    "identity": lambda b, x: x,
    "none": lambda b, x: x,
}


def activation_named(name: str) -> Activation | None:
    """The activation of a name, however it is written; None where it is not known."""
    return _KNOWN.get(name.lower().replace("_", "").replace("-", ""))


def name_of(activation: Activation) -> str:
    """Return the first name of one of the table."""
    return next(name for name, known in _KNOWN.items() if known is activation)


def activation_from_user(name: str) -> Activation:
    """The one that the user names. Raises UsageError."""
    found = activation_named(name)
    if found is None:
        raise UsageError(f"--activation {name}: unknown activation", fix=f"one of: {', '.join(sorted(_KNOWN))}")
    return found


_FILES = ("params/agent.yaml", "agent.yaml", "config.yaml", "params.yaml")
_LARGEST = 1 << 20
#: Nothing is tried twice (``*+``): a file of spaces would take seconds.
_LINE = re.compile(r"( *+)(?:- )?([\w.]++) *+: *+(?:['\"]?([\w.]++)['\"]?)? *+(?:#.*)?$")
#: Sections that describe the policy; a critic may have another activation.
_OF_POLICY = frozenset(("policy", "actor", "student", "model"))


def activation_of(
    given: Fetched, wanted: str | None, usual: str, default: tuple[str, str] | None = None
) -> tuple[Activation, tuple[Path, ...], tuple[str, ...]]:
    """Return (the activation, files that said it, notes).

    ``wanted`` is what the user names, ``usual`` what trainers have, ``default`` what is taken where nobody says it,
    with the note on that. Raises SourceError where nobody says it, UsageError where the user contradicts the file, or
    names none.
    """
    for name in _FILES:
        file = given.path.parent / name
        found = _activations_in(given, file)
        known = [activation_named(word) for word in found]
        if len(found) != 1 or known[0] is None:
            continue
        (word,) = found
        if wanted is not None and activation_from_user(wanted) is not known[0]:
            raise UsageError(
                f"--activation {wanted} contradicts {name}", why=f"it says {word}", fix="leave --activation out"
            )
        return known[0], (file,), (f"its activation is {word}, as {name} says",)
    if wanted is not None:
        return activation_from_user(wanted), (), ()
    if default is not None:
        name, note = default
        return activation_from_user(name), (), (note,)
    raise SourceError(
        "the checkpoint does not say which activation its layers use",
        why="a state dictionary has weights, and an activation has none",
        fix=f"add --activation NAME ({usual}); Isaac Lab writes it to params/agent.yaml, which is read if it is "
        "next to the checkpoint",
    )


def _activations_in(given: Fetched, file: Path) -> set[str]:
    """The activations of the policy that a file names."""
    try:
        if not file.is_file() or file.stat().st_size > _LARGEST:
            return set()
    except OSError:
        return set()
    text = given.bytes_of(file, empty=True).decode("utf-8", "replace")
    path: list[tuple[int, str]] = []
    found: set[str] = set()
    for line in text.splitlines():
        match = _LINE.match(line[:300])
        if match is None:
            continue
        indent, key, value = len(match[1]), match[2], match[3]
        while path and path[-1][0] >= indent:
            path.pop()
        path.append((indent, key))
        if value and key in ("activation", "activations") and any(k in _OF_POLICY for _, k in path[:-1]):
            found.add(value)
    return found
