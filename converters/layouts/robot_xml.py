"""A robot's joints from its URDF or MJCF: which hangs below which, and where and along what each moves at rest.

Sources: wiki.ros.org/urdf/XML/joint; mujoco.readthedocs.io/en/stable/XMLreference.html (angles in degrees and an axis
along z unless stated; classes of defaults). Joints stand in the order of the tree, depth first, as MuJoCo and Isaac
Gym number them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from xml.etree.ElementTree import Element

import numpy as np
from msgspec import Struct

from export_model.converters.interfaces.table import short_text
from export_model.signatures.errors import DamagedFileError

#: What moves along an axis in place of about it.
_SLIDING = ("prismatic", "slide")
_URDF_MOVES = ("revolute", "continuous", "prismatic")
#: Ways to turn a body that are not read.
_UNREAD_TURNS = ("xyaxes", "zaxis")


class PlacedJoint(Struct, frozen=True):
    """A joint at rest in the base's frame (x forward, y left, z up), and the joint ``above`` that it hangs from."""

    name: str
    above: str
    place: np.ndarray
    axis: np.ndarray
    slides: bool


def placed_joints(root: Element, name: str) -> list[PlacedJoint]:
    """The joints that move, in the tree's order. Raises DamagedFileError that names what is missing or not read."""
    try:
        if root.tag == "robot":
            found = list(_of_urdf(root))
        elif root.tag == "mujoco":
            found = list(_of_mjcf(root))
        else:
            raise ValueError(f"its root is <{short_text(root.tag, 40)}>, not <robot> (URDF) or <mujoco> (MJCF)")
        if len({joint.name for joint in found}) < len(found) or not found or not all(joint.name for joint in found):
            raise ValueError("its moving joints must have names, each another")
    except ValueError as error:
        fix = "give the URDF or the whole MJCF, or the robot's joints as YAML"
        raise DamagedFileError("is not a robot's file", where=name, why=str(error), fix=fix) from error
    return found


# ------------------------------------------------------------------ URDF


def _of_urdf(root: Element) -> Iterator[PlacedJoint]:
    below: dict[str, list[Element]] = {}
    children: set[str] = set()
    for joint in root.iterfind("joint"):
        below.setdefault(_link(joint, "parent"), []).append(joint)
        child = _link(joint, "child")
        if child in children:
            raise ValueError(f"link {short_text(child)!r} hangs from two joints")
        children.add(child)
    bases = [link for link in below if link not in children]
    if len(bases) != 1:
        raise ValueError(f"it has {len(bases)} base links; a robot has one")
    waiting = [(joint, "", np.eye(4)) for joint in reversed(below[bases[0]])]
    while waiting:
        joint, above, frame = waiting.pop()
        origin = joint.find("origin")
        roll, pitch, yaw = _numbers(origin, "rpy", (0, 0, 0))
        turn = _about("z", yaw) @ _about("y", pitch) @ _about("x", roll)
        frame = frame @ _frame(_numbers(origin, "xyz", (0, 0, 0)), turn)
        if joint.get("type") in _URDF_MOVES and joint.find("mimic") is None:
            axis = _numbers(joint.find("axis"), "xyz", (1, 0, 0))
            above_here, above = above, joint.get("name", "")
            yield _place_in(above, above_here, frame, (0, 0, 0), axis, str(joint.get("type")))
        waiting += [(j, above, frame) for j in reversed(below.get(_link(joint, "child"), []))]


def _link(joint: Element, end: str) -> str:
    part = joint.find(end)
    if part is None or not part.get("link"):
        raise ValueError(f"joint {short_text(joint.get('name', ''))!r} has no <{end} link=…>")
    return str(part.get("link"))


# ------------------------------------------------------------------ MJCF


def _of_mjcf(root: Element) -> Iterator[PlacedJoint]:
    world = root.find("worldbody")
    if world is None or next(root.iter("include"), None) is not None:
        raise ValueError("it has no <worldbody>, or includes other files: mj_saveLastXML writes all of it as one")
    options = {k: v for compiler in root.iterfind("compiler") for k, v in compiler.attrib.items()}
    unit = 1.0 if options.get("angle") == "radian" else math.pi / 180
    if options.get("eulerseq", "xyz") != "xyz":
        raise ValueError("its eulerseq is not xyz")
    classes: dict[str, Mapping[str, str]] = {"": {}}
    for default in root.iterfind("default"):
        _collect(default, {}, classes, "")
    driven = {motor.get("joint") for motors in root.iterfind("actuator") for motor in motors} - {None}
    waiting = [(body, "", "", np.eye(4)) for body in reversed(world.findall("body"))]
    while waiting:
        body, above, inherited, frame = waiting.pop()
        inherited = body.get("childclass", inherited)
        if body.find("freejoint") is None and body.find("joint[@type='free']") is None:  # a base begins where it is put
            frame = frame @ _frame(_numbers(body, "pos", (0, 0, 0)), _turn(body, unit))
        for joint in body.findall("joint"):
            stated = {**classes.get(joint.get("class", inherited), {}), **joint.attrib}
            kind = stated.get("type", "hinge")
            if kind == "free" or (driven and stated.get("name") not in driven):
                continue
            if kind == "ball":
                raise ValueError(f"joint {short_text(stated.get('name', ''))!r} is a ball: it has three numbers")
            axis, place = _vector(stated, "axis", (0, 0, 1)), _vector(stated, "pos", (0, 0, 0))
            above_here, above = above, stated.get("name", "")
            yield _place_in(above, above_here, frame, place, axis, kind)
        waiting += [(b, above, inherited, frame) for b in reversed(body.findall("body"))]


def _collect(default: Element, above: Mapping[str, str], classes: dict[str, Mapping[str, str]], name: str) -> None:
    """Class → attributes of its joints, with those of the classes that it stands in."""
    joint = default.find("joint")
    own = {**above, **({} if joint is None else joint.attrib)}
    classes[name] = classes[default.get("class", name)] = own
    for inner in default.iterfind("default"):
        _collect(inner, own, classes, inner.get("class", name))


def _turn(body: Element, unit: float) -> np.ndarray:
    if any(body.get(key) for key in _UNREAD_TURNS):
        raise ValueError(f"body {short_text(body.get('name', ''))!r} is turned by {' or '.join(_UNREAD_TURNS)}")
    if body.get("euler"):
        x, y, z = (unit * v for v in _numbers(body, "euler", (0, 0, 0)))
        turn: np.ndarray = _about("x", x) @ _about("y", y) @ _about("z", z)
        return turn
    if body.get("axisangle"):
        *axis, angle = _numbers(body, "axisangle", (0, 0, 1, 0))
        return _rotation(_unit(np.array(axis)), unit * angle)
    return _of_quaternion(_unit(np.array(_numbers(body, "quat", (1, 0, 0, 0)))))


# ------------------------------------------------------------------ frames


def _place_in(
    name: str, above: str, frame: np.ndarray, place: tuple[float, ...], axis: tuple[float, ...], kind: str
) -> PlacedJoint:
    turned = frame[:3, :3] @ _unit(np.array(axis, float))
    return PlacedJoint(name, above, frame[:3, :3] @ np.array(place) + frame[:3, 3], turned, kind in _SLIDING)


def _numbers(element: Element | None, key: str, default: tuple[float, ...]) -> tuple[float, ...]:
    return _vector({} if element is None else element.attrib, key, default)


def _vector(attributes: Mapping[str, str], key: str, default: tuple[float, ...]) -> tuple[float, ...]:
    """The numbers of an attribute. Raises ValueError where they are not as many as those of ``default``, or finite."""
    text = attributes.get(key)
    if text is None:
        return default
    words = text.split()
    found = tuple(float(word) for word in words[: len(default) + 1])
    if len(found) != len(default) or not all(map(math.isfinite, found)) or max(map(abs, found)) > 1e6:
        raise ValueError(f"{key}={short_text(text, 60)!r} is not {len(default)} numbers")
    return found


def _unit(vector: np.ndarray) -> np.ndarray:
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise ValueError("an axis or a quaternion has no length")
    unit: np.ndarray = vector / length
    return unit


def _about(axis: str, angle: float) -> np.ndarray:
    return _rotation(np.array([float(letter == axis) for letter in "xyz"]), angle)


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    half = angle / 2
    return _of_quaternion(np.array([math.cos(half), *(math.sin(half) * axis)]))


def _of_quaternion(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _frame(place: tuple[float, ...], turn: np.ndarray) -> np.ndarray:
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = turn, place
    return frame
