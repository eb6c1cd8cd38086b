"""Unitree's ``deploy.yaml``: what its controllers in C++ are given with a policy.

Source: unitree_rl_lab (utils/export_deploy_cfg.py; ``deploy/robots/*/config/policy/*/params/deploy.yaml``). A list of
scales has one number for each of the term's, so it states the size.
"""

from __future__ import annotations

from export_model.converters.interfaces.table import Table, short_text
from export_model.signatures.interface import Interface, Period, Quantity, Term

_QUANTITIES = {
    "stiffness": "stiffness",
    "damping": "damping",
    "default_joint_pos": "default position",
    "joint_ids_map": "place of each joint in the robot's own order",
}


def read_deploy(table: Table) -> Interface:
    """Return what it states of terms, gains and the control period."""
    observations, actions = table.below("observations"), table.below("actions")
    observed = [_term(observations.below(name), name) for name in observations if _is_term(observations, name)]
    acted = [_term(actions.below(name), name) for name in actions if _is_term(actions, name)]
    period = table.number("step_dt")
    return Interface(
        observations={"": tuple(observed)} if observed else {},
        actions=tuple(acted),
        period=None if not period or period < 0 else Period(period, table.where("step_dt")),
        quantities=tuple(
            Quantity(name=name, source=table.where(key), values=values)
            for key, name in _QUANTITIES.items()
            if (values := table.numbers(key))
        ),
        kept=tuple(table.rest()),
    )


def _is_term(group: Table, name: str) -> bool:
    entry = group.value(name)
    return isinstance(entry, dict) and "scale" in entry


def _term(entry: Table, name: str) -> Term:
    scale, offset, clip = entry.numbers("scale"), entry.numbers("offset"), entry.ranges("clip")
    listed = isinstance(entry.value("scale"), list) and len(scale) > 0
    size = len(scale) if listed else None
    frames = entry.count("history_length")
    names = entry.texts("joint_names")
    return Term(
        name=short_text(name),
        source=entry.where(),
        size=size,
        elements=names if size is not None and len(names) == size > 1 else (),
        scale=scale,
        offset=offset if size is None or len(offset) in (1, size) else (),
        clip=clip if size is None or len(clip) in (1, size) else (),
        history=None if frames is None else max(frames, 1),
    )
