"""``--robot FILE``: a user's own robot: its URDF or MJCF, or YAML with its joints, the pairs, what changes its sign."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from export_model.converters.files.fetch import read_bytes
from export_model.converters.files.yaml_data import MAX_YAML_BYTES, read_yaml
from export_model.converters.interfaces.table import Table
from export_model.converters.layouts.pairing import mirror_pairs
from export_model.converters.layouts.robot_xml import placed_joints
from export_model.converters.layouts.robots import ROBOTS, Chain, Robot
from export_model.converters.layouts.xml_data import MAX_XML_BYTES, read_xml
from export_model.signatures.errors import DamagedFileError, UsageError, suggestion
from export_model.signatures.fields import printable

#: What URDF and MJCF files end with.
_XML = (".urdf", ".xml", ".mjcf")
_FORM = "joints: [a_left, a_right, waist]; pairs: [[a_left, a_right]]; turned: [waist] (what changes its sign)"


def robots_named(wanted: str | None) -> Sequence[Robot]:
    """The robots that ``--robot`` means: all, the rows of one, or a file's. Raises UsageError, DamagedFileError."""
    if wanted is None:
        return ROBOTS
    rows = [robot for robot in ROBOTS if robot.key == wanted or robot.key.startswith(f"{wanted}-")]
    if rows:
        return rows
    if Path(wanted).suffix:
        return [read_robot(Path(wanted))]
    keys = [robot.key for robot in ROBOTS]
    raise UsageError(
        f"--robot {wanted}: no robot of that name is known",
        fix=f"{suggestion(wanted, keys)}{', '.join(keys)}; or a file: a URDF, an MJCF, or {_FORM}",
    )


def read_robot(path: Path) -> Robot:
    """The robot of a file.

    Raises DamagedFileError where a joint is missing, or stands in two pairs, UsageError where a URDF or an MJCF leaves
    open which joint is the mirror image of which.
    """
    if path.suffix.lower() in _XML:
        return _read_model(path)
    table = Table(read_yaml(read_bytes(path, most=MAX_YAML_BYTES), path.name), printable(path.name))
    joints, turned = table.texts("joints"), table.texts("turned")
    pairs = table.value("pairs") or []
    partners = {joint: joint for joint in joints}
    whole = isinstance(pairs, list) and all(isinstance(p, list) and len(p) == 2 for p in pairs)
    named = [joint for pair in pairs for joint in pair] if whole else []
    known = all(isinstance(j, str) and j in partners for j in (*named, *turned))
    if not joints or len(partners) < len(joints) or not whole or not known or len(set(named)) < len(named):
        raise DamagedFileError(
            "is not a robot's file",
            where=str(path),
            why="it must name each joint once, and in pairs and turned only these, each in one pair",
            fix=f"as this: {_FORM}",
        )
    partners |= {a: b for pair in pairs for a, b in (pair, reversed(pair))}
    told = {joint: (partners[joint], -1 if joint in turned else 1) for joint in joints}
    name = table.text("name") or path.stem
    return Robot(name, name, (Chain(joints),), (), (), printable(path.name), told=told)


def _read_model(path: Path) -> Robot:
    """The robot of a URDF or an MJCF."""
    where = printable(path.name)
    joints = placed_joints(read_xml(read_bytes(path, most=MAX_XML_BYTES), where), where)
    chains = tuple(Chain((joint.name,), joint.above) for joint in joints)
    return Robot(path.stem, path.stem, chains, (), (), where, told=mirror_pairs(joints, where))
