"""Isaac Lab's files of a run: ``IO_descriptors.yaml``, ``params/env.yaml`` and ``params/agent.yaml``.

Sources: isaaclab 2.2 (envs/utils/io_descriptors.py, ``docs/source/_static/policy_deployment``), managers'
configurations as ``dump_yaml`` writes them; isaaclab_rl 0.4 (``clip_actions`` of rsl_rl's agents, ``clip_actions`` and
``clip_observations`` below ``params.env`` of rl_games').
"""

from __future__ import annotations

from typing import TypeVar

from export_model.converters.interfaces.table import Table, short_text
from export_model.signatures.interface import Interface, Period, Quantity, Statement, Term

_Entry = TypeVar("_Entry")
#: The group of observations that the policy sees, as versions call it.
_GROUPS = ("policy", "actor")
#: What an articulation states, one for each joint: key → what it is, and its unit where Isaac Lab documents one.
_OF_JOINTS = {
    "default_joint_pos": "default position",
    "default_joint_stiffness": "stiffness",
    "default_joint_damping": "damping",
}
#: Name of the limit within which an action is put before its scale.
RAW_ACTION = "raw action"


def read_descriptors(table: Table) -> Interface:
    """Return what IO descriptors state: every term with its size, names, units, scales."""
    observations = table.below("observations")
    group = next((name for name in _GROUPS if name in observations), "")
    scene = table.below("scene")
    period = scene.number("dt")
    limits: list[Quantity] = []
    quantities: list[Quantity] = []
    articulations = table.below("articulations")
    for name in articulations:
        robot = articulations.below(name)
        joints = robot.texts("joint_names")
        for key, what in _OF_JOINTS.items():
            if values := robot.numbers(key):
                quantities.append(Quantity(name=what, source=robot.where(key), values=values, elements=joints))
        if clip := robot.ranges("default_joint_pos_limits"):
            limits.append(
                Quantity(
                    name="joint position", source=robot.where("default_joint_pos_limits"), clip=clip, elements=joints
                )
            )
    terms = tuple(_descriptor_term(row, ("joint_pos_offsets", "joint_vel_offsets")) for row in observations.rows(group))
    return Interface(
        observations={"": terms} if terms else {},
        actions=tuple(_descriptor_term(row, ("offset",)) for row in table.rows("actions")),
        period=None if not period or period < 0 else Period(period, scene.where("dt")),
        limits=tuple(limits),
        quantities=tuple(quantities),
        kept=tuple(table.rest()),
    )


def _descriptor_term(row: Table, offsets: tuple[str, ...]) -> Term:
    extras, overloads = row.below("extras"), row.below("overloads")
    shape = row.numbers("shape")
    size = int(shape[0]) if len(shape) == 1 and 0 < shape[0] < 1 << 24 and shape[0] == int(shape[0]) else None
    name = row.text("name") or "term"
    elements = row.texts("joint_names") or row.texts("body_names") or extras.texts("axes")
    frames = overloads.count("history_length")
    row.take("dtype", "mdp_type")
    overloads.take("flatten_history_dim")
    return Term(
        name=name,
        source=row.where(),
        size=size,
        elements=elements if size in (None, len(elements)) else (),
        unit=extras.text("units"),
        scale=_fitting(row.numbers("scale") or overloads.numbers("scale"), size),
        offset=_fitting(next((found for key in offsets if (found := row.numbers(key))), ()), size),
        clip=_fitting(row.ranges("clip") or overloads.ranges("clip"), size),
        history=None if frames is None else max(frames, 1),
    )


def read_environment(table: Table) -> Interface:
    """Return what ``env.yaml`` states: terms in order, without sizes; the control period; what ends an episode."""
    observations = table.below("observations")
    group = observations.below(next((name for name in _GROUPS if name in observations), ""))
    frames = group.count("history_length")
    names = [name for name in group if isinstance(group.value(name), dict) and "func" in group.value(name)]
    observed = [_configuration_term(group.below(name), name, frames) for name in names]
    actions = table.below("actions")
    acted = [_configuration_term(actions.below(n), n, 1) for n in actions if isinstance(actions.value(n), dict)]
    simulation = table.below("sim")
    step, decimation = simulation.number("dt"), table.count("decimation")
    period = round(step * decimation, 12) if step and decimation else 0
    where = f"{simulation.where('dt')} × decimation"
    resets = []
    length = table.number("episode_length_s")
    if length:
        resets.append(Statement(f"an episode lasts at most {length:g} s", table.where("episode_length_s")))
    terminations = table.below("terminations")
    ends = [name for name in terminations if isinstance(terminations.value(name), dict)]
    resets += [Statement(f"an episode ends at {short_text(name)}", terminations.where(name)) for name in ends]
    return Interface(
        observations={"": tuple(observed)} if observed else {},
        actions=tuple(acted),
        period=Period(period, where) if period > 0 else None,
        resets=tuple(resets),
        kept=tuple(table.rest()),
    )


def _configuration_term(entry: Table, name: str, frames: int | None) -> Term:
    """A term's configuration; the group's ``frames`` go before its own."""
    own = entry.count("history_length")
    length = own if frames is None else frames
    return Term(
        name=short_text(name),
        source=entry.where(),
        scale=entry.numbers("scale"),
        offset=entry.numbers("offset") if entry.value("use_default_offset") is not True else (),
        clip=entry.ranges("clip"),
        history=None if length is None else max(length, 1),
    )


def read_agent(table: Table) -> Interface:
    """Return the bounds that a trainer's wrapper puts actions and observations in."""
    environment = table.below("params").below("env")
    limits = []
    for holder, key, name in (
        (table, "clip_actions", RAW_ACTION),
        (environment, "clip_actions", RAW_ACTION),
        (environment, "clip_observations", "observation"),
    ):
        bound = holder.number(key)
        if bound is not None and bound > 0:
            limits.append(Quantity(name=name, source=holder.where(key), clip=((-bound, bound),)))
    return Interface(limits=tuple(limits), kept=tuple(table.rest()))


def _fitting(values: tuple[_Entry, ...], size: int | None) -> tuple[_Entry, ...]:
    """One value for all numbers, or one for each of a term; nothing where they are of another count."""
    return values if size is None or len(values) in (0, 1, size) else ()
