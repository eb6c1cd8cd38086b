"""The outputs that a user names with ``--output``: found in the graph, and checked with those that are known."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from export_model.converters.graph.nodes import Graph, normal_ref, split_ref
from export_model.signatures.errors import SignatureError, UsageError
from export_model.signatures.roles import ACTING, OUTPUT_ROLES, Role

#: The name, role and tensor of an output.
Output = tuple[str, Role, str]


def outputs_from_user(graph: Graph, wanted: Mapping[str, Role]) -> list[Output]:
    """Return (name, role, reference) of each output of ``--output``. Raises UsageError."""
    outputs: list[Output] = []
    for name, role in wanted.items():
        node_name, _ = split_ref(name)
        if node_name not in graph:
            raise UsageError(
                f"--output names {name!r}, which is not in the graph",
                why=close_names(node_name, [n.name for n in graph.nodes]),
                fix="export-model inspect FILE lists the outputs that were found",
            )
        if role not in OUTPUT_ROLES:
            roles = ", ".join(OUTPUT_ROLES)
            raise UsageError(f"--output {name}={role}: that is not an output's role", fix=f"one of: {roles}")
        outputs.append((node_name.rsplit("/", 1)[-1], role, normal_ref(name)))
    values = [reference for _, role, reference in outputs if role is Role.Q_VALUES]
    if len(values) > 1:
        raise UsageError(
            f"--output says that {len(values)} outputs are values of actions: {', '.join(values)}",
            why="the action is the best of one of them",
            fix="give the role q_values to that one, and other to the rest",
        )
    return outputs


def check_given(given: Sequence[Output], roles: Collection[Role], names: Mapping[str, str]) -> None:
    """Raise SignatureError where the user's roles leave no action, or two outputs of one name.

    ``roles`` are those of all outputs, ``names`` their canonical names by the source's.
    """
    said = ", ".join(f"--output {reference.removesuffix(':0')}={role}" for _, role, reference in given)
    if not any(role in ACTING for role in roles):
        raise SignatureError(
            f"{said} leaves no action",
            why="nothing else there may be the action",
            fix="say which tensor is the action, too: --output NAME=action",
        )
    twice = [base for base, name in names.items() if list(names.values()).count(name) > 1]
    if twice:
        raise SignatureError(
            f"{said} gives one role to {len(twice)} outputs",
            why=f"{' and '.join(twice)} would both be called {names[twice[0]]}",
            fix=f"give the rest another: --output {twice[-1]}=other",
        )


def close_names(name: str, names: Sequence[str]) -> str | None:
    """What may have been meant by a name that is not there."""
    import difflib

    near = difflib.get_close_matches(name, names, n=3)
    return f"close to it: {', '.join(near)}" if near else None
