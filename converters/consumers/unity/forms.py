"""Forms of inputs and outputs that a player trips over, and the words for one: what the rows of ``players`` ask."""

from __future__ import annotations

import math
from collections.abc import Mapping

from export_model.converters.consumers.mlagents.names import ACTION, CONTINUOUS
from export_model.converters.consumers.unity.layout import reads_flat
from export_model.converters.consumers.unity.scene import Scene, ScenePort
from export_model.signatures.roles import MEMORY_SIZE


def sensor_size(port: ScenePort) -> int:
    """The numbers that the sensor gives."""
    return math.prod(port.sensor)


def lacks_axes(port: ScenePort) -> bool:
    """Whether it has fewer axes than what is written into it."""
    return len(port.lengths) < len(port.sensor)


def outside_last(port: ScenePort, axes: int) -> bool:
    """Whether an agent's numbers lie on other axes than the last: players count from the agent by the last lengths."""
    return any(length > 1 for length in port.lengths[: len(port.lengths) - axes])


def off_channels(port: ScenePort) -> bool:
    """Whether numbers lie on Barracuda's height or width."""
    return port.view is not None and max(port.view.height, 1) * max(port.view.width, 1) > 1


def masks_of_another_size(port: ScenePort, scene: Scene) -> bool:
    """Whether masks have another number of columns than the agent has actions."""
    return bool(scene.brain.branches) and port.size not in (1, sum(scene.brain.branches))


def written_outside(port: ScenePort, scene: Scene) -> bool:
    """Whether Barracuda's tensor ends before the sensor's last number, at the place that ML-Agents writes it to."""
    del scene
    assert port.view is not None
    if 0 in (port.view.height, port.view.width, port.view.channels):
        return False
    return _last_place(port) >= port.view.height * port.view.width * port.view.channels


def turned_picture(port: ScenePort, scene: Scene) -> bool:
    """Whether a picture is written into a tensor of other lengths that has room for it."""
    if len(port.sensor) != 3 or written_outside(port, scene):
        return False
    assert port.view is not None
    return port.sensor != (port.view.channels, port.view.height, port.view.width)


def _last_place(port: ScenePort) -> int:
    assert port.view is not None
    if len(port.sensor) < 3:
        return sensor_size(port) - 1
    channels, height, width = port.sensor
    return ((height - 1) * port.view.width + width - 1) * port.view.channels + channels - 1


def misreads_entities(port: ScenePort, scene: Scene) -> bool:
    """Whether a list of entities is read in another order than the one in which it is written."""
    if len(port.sensor) != 2 or min(port.sensor) < 2:
        return False
    return _keeps_entities(port) or not reads_flat(port.name, scene.file, scene.nn)


def _keeps_entities(port: ScenePort) -> bool:
    return port.view is not None and port.view.kept


_TURNED = "transposed, and ML-Agents writes it flat: the model sees the observation transposed"
_KEPT = "channels last, as the pictures: the agent is asked for another sensor, and the model throws or acts otherwise"


def action_width(port: ScenePort, scene: Scene) -> int:
    """The columns that the agent takes of an action."""
    brain = scene.brain
    if port.name.endswith(CONTINUOUS) or (port.name == ACTION and brain.continuous):
        return brain.continuous
    return sum(brain.branches) if scene.old_names else len(brain.branches)


def gives_too_few(port: ScenePort, scene: Scene) -> bool:
    """Whether actions have fewer columns than the agent takes."""
    return port.dims is not None and len(port.dims) > 1 and port.size < action_width(port, scene)


def gives_too_many(port: ScenePort, scene: Scene) -> bool:
    """Whether actions have more columns than the agent takes, and it takes some."""
    return port.dims is not None and len(port.dims) > 1 and port.size > action_width(port, scene) > 0


def given_off_channels(port: ScenePort, scene: Scene) -> bool:
    """Whether actions lie on other axes than the second."""
    if port.dims is None or action_width(port, scene) < 2:
        return False
    return len(port.dims) < 2 or port.size != port.lengths[0]


def fields(port: ScenePort, scene: Scene) -> Mapping[str, object]:
    """What the sentences of a row may name."""
    free = "N" if port.dims is None or not port.dims or port.dims[0] is None or port.view is None else port.dims[0]
    lengths = port.lengths if port.dims is not None or port.view is not None else ()
    declared = () if port.dims is None else port.dims
    return {
        "name": port.name,
        "index": port.index,
        "shape": f"[{', '.join(map(str, (free, *lengths)))}]",
        "size": math.prod(lengths),
        "sensor": "x".join(map(str, port.sensor)),
        "sensor_lengths": ", ".join(map(str, port.sensor)),
        "declare": f"[{', '.join(map(str, ('N', *port.sensor)))}]",
        "entities": _KEPT if _keeps_entities(port) else _TURNED,
        "axes": len(port.sensor) + 1,
        "wanted": sensor_size(port) if port.sensor else _columns(port, scene),
        "batch": free,
        "expected": f"({', '.join('d0' if d is None else str(d) for d in declared)})",
        "received": f"({', '.join(map(str, ('N', *lengths)))})",
        MEMORY_SIZE: scene.model.memory_size,
        "namespace": scene.consumer.namespace,
        "profile": scene.consumer.profile,
    }


def _columns(port: ScenePort, scene: Scene) -> int:
    return sum(scene.brain.branches) if port.view is not None else action_width(port, scene)
