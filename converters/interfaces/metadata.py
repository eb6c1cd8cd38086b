"""The metadata of an ONNX model (``metadata_props``), as exporters for robots write it: lists as CSV or JSON.

Sources: mjlab 1.6 (rl/exporter_utils.py: CSV with three decimals, ``;`` within an entry; tasks/tracking/rl/runner.py),
whole_body_tracking (utils/exporter.py: the same without scales of observations, and ``observation_history_lengths``);
forks write the same keys as JSON. Loaders ask for more: HybridRobotics/motion_tracking_controller@main
(src/MotionOnnxPolicy.cpp and its base class) stops without ``anchor_body_name`` and ``body_names``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from export_model.converters.interfaces.table import Table, numbers_of, ranges_of
from export_model.signatures.bounded import loads
from export_model.signatures.interface import MAX_METADATA_CHARACTERS, MAX_TERMS, MAX_VALUES, Interface, Quantity, Term

FILE = "metadata_props"
#: What only such exporters write; other metadata is kept and not read.
_KNOWN = {"joint_names", "observation_names", "action_scale", "default_joint_pos"}
#: Keys that exporters write and loaders ask for; a file of these is an interface, too.
METADATA_KEYS = (
    *("joint_names", "joint_stiffness", "joint_damping", "default_joint_pos", "action_scale", "command_names"),
    *("observation_names", "observation_history_lengths", "anchor_body_name", "body_names", "run_path"),
)
#: Key → what its numbers are, one for each joint.
_OF_JOINTS = {
    "joint_stiffness": "stiffness",
    "joint_damping": "damping",
    "default_joint_pos": "default position",
}


def metadata_in(content: Mapping[str, Any]) -> dict[str, str]:
    """The keys of a file that loaders ask for, as exporters write them: lists as CSV, tables as JSON."""
    found = {}
    for key in METADATA_KEYS:
        value = content.get(key)
        plain = isinstance(value, list) and not any(isinstance(v, list | dict) or "," in str(v) for v in value)
        if value is not None:
            found[key] = ",".join(map(str, value)) if plain else value if isinstance(value, str) else json.dumps(value)
    return found


def read_metadata(given: Mapping[str, str], file: str = FILE) -> Interface | None:
    """Return what a model's metadata states, with all of it unchanged; None where it has none, or beyond bounds."""
    if not given or sum(len(k) + len(v) for k, v in given.items()) > MAX_METADATA_CHARACTERS:
        return None
    if not _KNOWN & given.keys():
        return Interface(metadata=dict(given))
    table = Table({key: _value(text) for key, text in given.items()}, file)
    joints = table.texts("joint_names")
    scale = table.numbers("action_scale")
    size = len(scale) if isinstance(table.value("action_scale"), list) else None
    named = joints if size in (None, len(joints)) else ()
    where = f"{table.where('action_scale')}, joint_names" if named else table.where("action_scale")
    action = Term(name="action", source=where, size=size, elements=named if size else (), scale=scale)
    observed = _observations(table)
    quantities = tuple(
        Quantity(
            name=name, source=table.where(key), values=values, elements=joints if len(joints) == len(values) else ()
        )
        for key, name in _OF_JOINTS.items()
        if (values := table.numbers(key))
    )
    if joints and not any(q.elements for q in quantities):
        quantities = (*quantities, Quantity(name="joints", source=table.where("joint_names"), elements=joints))
    return Interface(
        observations={"": observed} if observed else {},
        actions=(action,) if scale else (),
        quantities=quantities,
        kept=tuple(table.rest()),
        metadata=dict(given),
    )


def _observations(table: Table) -> tuple[Term, ...]:
    names = table.texts("observation_names")
    if len(names) > MAX_TERMS:
        return ()
    found = []
    scales = _per_term(table, "observation_terms_scale", names)
    clips = _per_term(table, "observation_terms_clip", names)
    frames = _per_term(table, "observation_terms_history_length", names) or _per_term(
        table, "observation_history_lengths", names
    )
    for i, name in enumerate(names):
        scale = numbers_of(scales[i]) if scales else ()
        length = numbers_of(frames[i]) if frames else ()
        history = int(length[0]) if len(length) == 1 and 0 <= length[0] < 1 << 16 else None
        found.append(
            Term(
                name=name,
                source=table.where(f"observation_names[{i}]"),
                size=len(scale) if len(scale) > 1 else None,
                scale=scale,
                clip=ranges_of(clips[i]) if clips else (),
                history=None if history is None else max(history, 1),
            )
        )
    return tuple(found)


def _per_term(table: Table, key: str, names: tuple[str, ...]) -> list[Any] | None:
    """One value for each term: a list, or a table by names; None where it is neither."""
    value = table.value(key)
    if isinstance(value, dict):
        value = [value.get(name) for name in names]
    elif not isinstance(value, list):
        value = [value] if value is not None and len(names) == 1 else None
    if not isinstance(value, list) or len(value) != len(names):
        return None
    table.take(key)
    return value


def _value(text: str) -> Any:
    """What the text of a key says: JSON, or entries between commas, each a number, a name, or several by ``;``."""
    start = text.lstrip()[:1]
    if start and start in "[{":
        try:
            return loads(text)
        except (ValueError, RecursionError):
            return text
    if text.count(",") + text.count(";") >= MAX_VALUES:
        return text
    entries = [_entry(entry) for entry in text.split(",")]
    return entries[0] if len(entries) == 1 else entries


def _entry(text: str) -> Any:
    if ";" in text:
        return [_number(part) for part in text.split(";")]
    return _number(text)


def _number(text: str) -> Any:
    word = text.strip()
    if len(word) > 40 or "_" in word:  # Python's float takes 1_000
        return word
    try:
        return float(word)
    except ValueError:
        return word
