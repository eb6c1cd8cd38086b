"""What an agent observes, as far as its network's weights tell: sensors in the order in which the network joins them.

A normaliser's length is its sensor's; a vector without normaliser has no weights of its own, only its share of the
first layer's width. An image's size is lost in the encoder's last layer, where height times width is one number. Lists
of entities (BufferSensor) do not tell how many there are at most, and which sensor is a goal only its width tells.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from msgspec import Struct

from export_model.converters.policy.rules import Rule, first
from export_model.converters.trainers.mlagents.state import LET_IT_EXPORT
from export_model.converters.trainers.pytorch.weights import Weights
from export_model.signatures.errors import SourceError, UsageError

#: Larger sides are not looked for.
_LONGEST = 1024
#: Among more sensors goals are not looked for.
_MOST_SENSORS = 16
_SAY = "say what the agent observes, sensor by sensor in the order of their names: --sensors SHAPE,... with shapes like"


class SensorInput(Struct, frozen=True):
    """One input of the network.

    ``shape`` has lists of entities as [most, numbers], images as C, H, W; ``module`` is None where the numbers go in as
    they are; ``says`` is why it is a sensor. ``places`` are those of the agent's sensors that it joins, as the user
    says; empty where nobody does.
    """

    shape: tuple[int, ...]
    module: str | None
    says: str = "--sensors says so"
    places: tuple[int, ...] = ()


class Encoder(Struct, frozen=True):
    """A visual encoder: what each side of an image becomes, by (kernel, stride) of convolutions and pools."""

    key: str
    windows: tuple[tuple[int, int], ...]
    channels: int

    def side(self, length: int) -> int:
        """The side of the last feature map; 0 or less: the image is too small."""
        for kernel, stride in self.windows:
            length = (length - kernel) // stride + 1
        return length


#: By the width of the first convolution and the number of convolutions (encoders.py).
_SIMPLE = Encoder("simple", ((8, 4), (4, 2)), 32)
_NATURE = Encoder("nature_cnn", ((8, 4), (4, 2), (3, 1)), 64)
_MATCH3 = Encoder("match3", ((3, 1), (3, 1)), 144)
_RESNET = Encoder("resnet", ((3, 2), (3, 2), (3, 2)), 32)
_DENSE = Encoder("fully_connected", (), 0)


def encoder_of(state: Weights, module: str) -> Encoder | None:
    """The visual encoder that a module is, None where it is none."""
    names = state.under(f"{module}.")
    if any(n.startswith("sequential.") for n in names):
        return _RESNET
    convolutions = sorted(n for n in names if n.startswith("conv_layers.") and n.endswith(".weight"))
    if not convolutions:
        return _DENSE if "dense.0.weight" in names else None
    shape = state.shape(f"{module}.{convolutions[0]}")
    if len(convolutions) == 3:
        return _NATURE
    return _SIMPLE if shape[-1] == 8 else _MATCH3


def dense_name(state: Weights, module: str) -> str:
    """The last layer of a visual encoder."""
    return f"{module}.dense" if f"{module}.dense.weight" in state else f"{module}.dense.0"


# ------------------------------------------------------------------ in which order


class SensorModule(Struct, frozen=True):
    """A module of a checkpoint that encodes a sensor."""

    state: Weights
    name: str


class Layout(Struct, frozen=True):
    """What the weights tell of all sensors.

    ``modules`` are in their order (None: one without weights), ``known`` are the columns that each takes of the first
    layer, and ``rest`` is how many are left over; ``two_lists``: vectors stand before the images.
    """

    modules: Sequence[str | None]
    known: Mapping[str, int]
    images: Sequence[str]
    rest: int
    two_lists: bool

    @property
    def only_images(self) -> bool:
        """Whether all that have weights are images, and vectors stand at one end."""
        ends = self.two_lists or None not in self.modules
        return bool(self.images) and len(self.images) == len(self.known) and ends


#: What a module encodes.
_IMAGE, _VECTOR, _LIST = "an image", "a normalised vector", "a list of entities"
_KINDS: tuple[Rule[SensorModule, str], ...] = (
    Rule(_IMAGE, lambda m: encoder_of(m.state, m.name) is not None, "its module has the layers of a visual encoder"),
    Rule(
        _VECTOR,
        lambda m: f"{m.name}.normalizer.running_mean" in m.state,
        "its module has the mean and the variance of a normaliser",
    ),
    Rule(_LIST, lambda m: _is_list(m.state, m.name), "its module encodes entities for attention"),
)
#: Where the columns go that no module takes: nowhere, into the one vector, into one beside images.
_NONE_LEFT, _ONE_VECTOR, _BESIDE_IMAGES = "none left", "one vector", "a vector beside images"
_LAYOUTS: tuple[Rule[Layout, str], ...] = (
    Rule(
        _NONE_LEFT,
        lambda s: s.rest == 0 and None not in s.modules,
        "the modules take all columns of the first layer",
    ),
    Rule(
        _ONE_VECTOR,
        lambda s: not s.images and not s.known,
        "no sensor has its own weights, so that the first layer takes vectors alone",
    ),
    Rule(
        _BESIDE_IMAGES,
        lambda s: s.only_images,
        "it has the columns of the first layer that the images do not take",
    ),
)


def find_sensors(
    state: Weights, lists: Sequence[str], encoder: str, width: int, told: Sequence[tuple[int, ...]]
) -> tuple[list[SensorInput], bool]:
    """The sensors in the order of the first layer's columns (``width`` of them), and whether vectors stand joined.

    ``encoder`` is what holds the attention over lists of entities, whose result is the last columns.
    ``lists`` are the module lists (0.22, 0.23: vectors, then images; later one list), ``told`` the shapes that the
    user gives, one per sensor. Raises SourceError where they do not follow from the weights, UsageError where what
    the user says contradicts them.
    """
    modules = _modules(state, lists)
    kinds = {m: _kind(state, m).role for m in modules if m is not None}
    entities = [m for m in kinds if _is_list(state, m)]
    lengths = {m: _entity_length(state, m, encoder) for m in entities}
    if lengths:
        width -= state.length(f"{encoder}.rsa.fc_q.weight", 0)
    if told:
        return _from_user(state, lists, modules, lengths, width, told), False
    if lengths:
        sizes = ", ".join(str(n) for n in lengths.values())
        raise SourceError(
            "the checkpoint does not say how many entities the agent's lists have at most",
            why=f"it attends to entities of {sizes} numbers (BufferSensor), any number of them",
            fix=f"{_SAY} 8 for a vector, 3x84x84 for an image, 20x{next(iter(lengths.values()))} for a list of at "
            "most 20 entities",
        )
    known = {m: _known_width(state, m) for m in kinds}
    images = [m for m, kind in kinds.items() if kind == _IMAGE]
    layout = Layout(modules, known, images, width - sum(known.values()), len(lists) > 1)
    if layout.rest < 0:
        raise state.damaged_error(
            f"its sensors have {width - layout.rest} columns, and its first layer takes {width}",
            "the checkpoint is of a network that ML-Agents did not build, or damaged",
        )
    return _arrange(state, layout, width)


def _modules(state: Weights, lists: Sequence[str]) -> list[str | None]:
    """The modules of all sensors in their order; what has no weights is a vector that is not normalised."""
    modules: list[str | None] = []
    for prefix in lists:
        indices = state.indices(prefix)
        if indices and len(lists) == 1:
            modules.extend(f"{prefix}{i}" if i in indices else None for i in range(indices[-1] + 1))
        else:
            modules.extend(f"{prefix}{i}" for i in indices)
    return modules


def _kind(state: Weights, module: str) -> Rule[SensorModule, str]:
    """The rule that says what a module encodes. Raises SourceError."""
    rule = first(_KINDS, SensorModule(state, module))
    if rule is None:
        raise state.unsupported_error(
            f"{module} ({', '.join(state.under(module + '.')[:3])})",
            "it encodes a sensor as no ML-Agents does; a plugin may have made it",
        )
    return rule


def _arrange(state: Weights, layout: Layout, width: int) -> tuple[list[SensorInput], bool]:
    """The sensors, and whether vectors stand joined. Raises SourceError."""
    rule, rest = first(_LAYOUTS, layout), layout.rest
    if rule is None:
        raise SourceError(
            "the checkpoint does not say which sensors the agent has",
            why=f"{rest} of the {width} columns of its first layer belong to vectors that leave no trace, with "
            "images between them",
            fix=f"{_SAY} 8 for a vector and 3x84x84 for an image; or {LET_IT_EXPORT}",
        )
    seen = [_told_by_weights(state, m) for m in layout.known]
    if rule.role == _NONE_LEFT:
        return seen, False
    vector = SensorInput((rest,), None, rule.says)
    return ([vector, *seen] if layout.two_lists else [*seen, vector]), True


def find_goals(
    state: Weights, sensors: Sequence[SensorInput], width: int, told: Sequence[int], *, joined: bool
) -> tuple[int, ...]:
    """The places of the sensors that the last hidden layer's weights are made from, ``width`` numbers in all.

    Raises SourceError where the widths do not tell them, UsageError where what the user says contradicts them.
    """
    widths = {
        i: s.shape[0] if len(s.shape) == 1 else _known_width(state, s.module)
        for i, s in enumerate(sensors)
        if len(s.shape) != 2
    }
    given = ",".join(f"{'goal:' if i in told else ''}{'x'.join(map(str, s.shape))}" for i, s in enumerate(sensors))
    if told:
        if any(i not in widths for i in told) or sum(widths[i] for i in told) != width:
            raise UsageError(
                f"--sensors {given} does not fit the checkpoint",
                why=f"its goals have {width} numbers" if width else "its network is not conditioned on a goal",
                fix="mark the sensors that are goals: goal:8" if width else "leave goal: out",
            )
        return tuple(sorted(told))
    if not width:
        return ()
    fitting = [] if joined or len(widths) > _MOST_SENSORS else _summing(tuple(widths.items()), width)
    if len(fitting) == 1:
        return fitting[0]
    raise SourceError(
        "the checkpoint does not say which of the agent's sensors is its goal",
        why=f"the goals have {width} of the numbers that it observes"
        + (f", and several sensors may have them ({given})" if fitting else ""),
        fix=f"{_SAY} 8 for a vector and 3x84x84 for an image, goal: before a goal (8,goal:{width})",
    )


def _summing(widths: Sequence[tuple[int, int]], total: int) -> list[tuple[int, ...]]:
    """The ways (two at most) in which some of the sensors have ``total`` numbers together."""
    found: list[tuple[int, ...]] = []

    def search(start: int, left: int, taken: tuple[int, ...]) -> None:
        if left == 0:
            found.append(taken)
        for at in range(start, len(widths)):
            if len(found) < 2 and widths[at][1] <= left:
                search(at + 1, left - widths[at][1], (*taken, widths[at][0]))

    search(0, total, ())
    return found


def _is_list(state: Weights, module: str) -> bool:
    return f"{module}.self_ent_encoder.seq_layers.0.weight" in state


def _entity_length(state: Weights, module: str, encoder: str) -> int:
    """The numbers of one entity: what its encoder reads, without what the agent observes of itself."""
    read = state.length(f"{module}.self_ent_encoder.seq_layers.0.weight", -1)
    own = f"{encoder}.x_self_encoder.seq_layers.0.weight"
    return read - (state.length(own, 0) if own in state else 0)


def _known_width(state: Weights, module: str | None) -> int:
    assert module is not None
    if encoder_of(state, module) is not None:
        return state.length(f"{dense_name(state, module)}.weight", 0)
    return state.length(f"{module}.normalizer.running_mean", 0)


def _told_by_weights(state: Weights, module: str) -> SensorInput:
    """A sensor whose shape follows from its module."""
    encoder, says = encoder_of(state, module), _kind(state, module).says
    if encoder is None:
        return SensorInput(state.shape(f"{module}.normalizer.running_mean"), module, says)
    columns = state.length(f"{dense_name(state, module)}.weight", 1)
    sizes = _sizes(state, module, encoder, columns)
    if len(sizes) == 1:
        return SensorInput(sizes[0], module, says)
    squares = [s for s in sizes if s[1] == s[2]]
    example = squares[0] if squares else sizes[0] if sizes else (3, 84, 84)
    shown = ", ".join("x".join(map(str, s)) for s in (squares or sizes)[:8])
    raise SourceError(
        f"the checkpoint does not say the size of the image that {module} sees",
        why=f"{says} ({encoder.key}), which ends in {columns} numbers, and {len(sizes)} sizes give that"
        + (f"; {'square ones' if squares else 'some'}: {shown}" if shown else ""),
        fix=f"{_SAY} 8 for a vector and {'x'.join(map(str, example))} for an image; or {LET_IT_EXPORT}",
    )


def _sizes(state: Weights, module: str, encoder: Encoder, columns: int) -> list[tuple[int, int, int]]:
    """The image sizes C, H, W that an encoder may have been built for."""
    if encoder is _DENSE:
        if columns > _LONGEST**2:
            return []
        return [
            (c, h, columns // c // h)
            for c in range(1, columns + 1)
            if columns % c == 0
            for h in range(1, columns // c + 1)
            if columns // c % h == 0
        ][:_LONGEST]
    channels, area = _channels(state, module, encoder), columns // encoder.channels
    if columns % encoder.channels or area < 1:
        return []
    sides: dict[int, list[int]] = {}
    for length in range(1, _LONGEST + 1):
        if encoder.side(length) >= 1:
            sides.setdefault(encoder.side(length), []).append(length)
    return [
        (channels, h, w) for rows in sides if area % rows == 0 for h in sides[rows] for w in sides.get(area // rows, [])
    ]


def _channels(state: Weights, module: str, encoder: Encoder) -> int:
    first = "sequential.0.weight" if encoder is _RESNET else "conv_layers.0.weight"
    shape = state.shape(f"{module}.{first}")
    return shape[1] if len(shape) == 4 else 0


# ------------------------------------------------------------------ as the user says


def _from_user(
    state: Weights,
    lists: Sequence[str],
    modules: Sequence[str | None],
    lengths: Mapping[str, int],
    width: int,
    told: Sequence[tuple[int, ...]],
) -> list[SensorInput]:
    """The sensors that the user names, checked against the weights. Raises UsageError."""
    places: list[tuple[int, ...]] = [(i,) for i in range(len(told))]
    if len(lists) > 1:  # 0.20 to 0.23: all vectors joined before the images
        vectors = tuple(i for i, s in enumerate(told) if len(s) == 1)
        places = [*([vectors] if vectors else []), *((i,) for i, s in enumerate(told) if len(s) == 3)]
        told = [told[p[0]] if len(p) == 1 else (sum(told[i][0] for i in p),) for p in places]
        normalised = any(m is not None and encoder_of(state, m) is None for m in modules)
        modules = [*([None] if vectors and not normalised else []), *modules]
    given = [*modules, *[None] * (len(told) - len(modules))]
    if len(given) != len(told):
        raise _contradiction(told, f"its network has {len(modules)} sensors")
    columns = 0
    for number, (shape, module) in enumerate(zip(told, given, strict=True)):
        length = None if module is None else lengths.get(module)
        if length is not None or len(shape) == 2:
            if len(shape) != 2 or length != shape[1]:
                known = "no list of entities" if length is None else f"a list of entities of {length} numbers"
                raise _contradiction(told, f"its sensor {number} is {known}")
        else:
            columns += _columns_as_told(state, number, module, shape, told)
    if columns != width:
        raise _contradiction(told, f"its first layer takes {width} columns, and these sensors give {columns}")
    return [SensorInput(tuple(s), module, places=p) for s, module, p in zip(told, given, places, strict=True)]


def _columns_as_told(
    state: Weights, number: int, module: str | None, shape: tuple[int, ...], told: Sequence[tuple[int, ...]]
) -> int:
    """Columns of the first layer that a vector or an image takes. Raises UsageError where its shape is another."""
    encoder = None if module is None else encoder_of(state, module)
    if (len(shape) == 3) != (encoder is not None):
        place = "without weights" if module is None else module
        raise _contradiction(told, f"its sensor {number} ({place}) is {'an image' if encoder else 'a vector'}")
    if module is None:
        return shape[0]
    if encoder is not None:
        _check_image(state, module, encoder, shape, told)
        return _known_width(state, module)
    mean = f"{module}.normalizer.running_mean"
    if state.shape(mean) != shape:
        raise _contradiction(told, f"{module} has {state.length(mean, 0)} numbers")
    return shape[0]


def _check_image(
    state: Weights, module: str, encoder: Encoder, shape: tuple[int, ...], told: Sequence[tuple[int, ...]]
) -> None:
    columns = state.length(f"{dense_name(state, module)}.weight", 1)
    if encoder is _DENSE:
        fits = math.prod(shape) == columns
    else:
        sides = [encoder.side(n) for n in shape[1:]]
        channels = _channels(state, module, encoder)
        fits = shape[0] == channels and min(sides) >= 1 and math.prod(sides) * encoder.channels == columns
    if not fits:
        raise _contradiction(told, f"{module} ({encoder.key}) was not built for an image of {shape}")


def _contradiction(told: Sequence[tuple[int, ...]], why: str) -> UsageError:
    text = ",".join("x".join(map(str, s)) for s in told)
    return UsageError(
        f"--sensors {text} does not fit the checkpoint",
        why=why,
        fix="give one shape per sensor, in the order of the sensors' names: 8 for a vector, 20x4 for a list of "
        "entities, 3x84x84 for an image",
    )
