"""The contract: what policy.json says, and the copy that every artefact embeds. Only here is it parsed and validated.

A contract comes from a file, so it is not trusted: types, ranges, names that can be printed, keys of files that stay
inside the bundle. What is wrong is said with the field that it stands in (``outputs[1].shape``). Keys that are not
known are left alone.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Annotated, Any, Literal, NotRequired, TypedDict

import numpy as np
from msgspec import Meta, Struct, field, to_builtins
from msgspec.structs import replace

from export_model.signatures.bounded import loads
from export_model.signatures.code import CHOICES
from export_model.signatures.fields import (
    WHOLE,
    Blank,
    Count,
    FieldError,
    Number,
    Record,
    Text,
    Whole,
    one_of,
    path_text,
    read,
)
from export_model.signatures.interface import parse_interface
from export_model.signatures.labels import parse_labels
from export_model.signatures.roles import INPUT_ROLES, Role
from export_model.signatures.spec import Dtype, PolicySignature, SourceMap, TensorSpec, sources

POLICY, PARITY = "policy.json", "parity.json"
SCHEMA = 1
#: What an artefact calls the copy that it embeds: a node of a graph, a property of a model.
EMBEDDED = "export_model_contract"
_Name = Annotated[str, Meta(pattern=r"^(?!\.+$)[A-Za-z0-9._-]{1,255}$", title="the name of a policy, as of a file")]
_Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$", title="a sha256 in hexadecimal")]
_OUTPUT_ROLES = tuple(r for r in Role if r not in INPUT_ROLES)
#: What a placeholder that is fixed may hold.
_MOST_FIXED = 1_000_000
#: Numbers that one agent may be fed in all (five images of 512x512x3), and actions in all branches: what is tried and
#: shown is made of them, whatever the file's size.
_MOST_FED, _MOST_ACTIONS = 1 << 22, 1 << 16
#: Role → the ranks that whoever reads the role relies on; of others any.
_RANKS = {
    Role.VISUAL: (4,),
    Role.MASKS: (2,),
    Role.PREV_ACTION: (1, 2),
    **dict.fromkeys((Role.VECTOR, Role.ENTITIES, Role.CONTINUOUS, Role.LOG_PROBS, Role.PROBS), tuple(range(1, 33))),
    Role.Q_VALUES: (2, 3),
}


_Sensor = Annotated[tuple[Annotated[int, Meta(ge=1, le=2**63 - 1)], ...], Meta(max_length=8)]


class FileEntry(Record, frozen=True, rename={"size": "bytes"}):
    """One file of a bundle.

    - ``sha256``: SHA-256 of the file's bytes, in hexadecimal.
    - ``bytes``: the file's size in bytes.
    """

    sha256: _Sha256
    size: Count


class Origin(Record, frozen=True):
    """Where a policy comes from, and how its source was read; fields beside these say how it is run, and are internal.

    - ``path``: base name of the file.
    - ``sha256``: SHA-256 of the file's bytes, in hexadecimal.
    - ``model``: which of a source's policies it is.
    - ``step``: step of the checkpoint (--step).
    - ``sensors``: shapes of the agent's sensors (--sensors).
    - ``goals``: which of the sensors are goals, by their place.
    - ``activation``: activation between layers (--activation).
    - ``script``: script that saved the weights (--script).
    - ``repair``: fault of the exporter that was mended (--repair).
    - ``normaliser``: file of the observations' statistics (--normaliser), or none.
    """

    path: Text
    sha256: _Sha256
    model: Blank | None = None
    step: Whole | None = None
    sensors: Annotated[tuple[_Sensor, ...], Meta(max_length=1000)] = ()
    goals: Annotated[tuple[Count, ...], Meta(max_length=1000)] = ()
    activation: Text | None = None
    script: Text | None = None
    repair: Text | None = None
    normaliser: Text | None = None


#: The fields of Origin that are options of reading, and the same in ReadOptions.
READ_BY = tuple(name for name in Origin.__struct_fields__ if name not in ("path", "sha256", "model"))


class CodeSection(TypedDict, total=False):
    """How source code was written, where not as usual.

    - ``math``: mathematical functions are the source code's own, the same bits on every processor (--math).
    - ``weights``: weights are in a file beside the source code (--weights).
    - ``outputs``: source code gives all outputs, not the actor's alone (--outputs).
    - ``guard``: beyond how many deviations an observation is unusual (--guard).
    """

    math: Annotated[str, one_of(CHOICES["math"][1:])]
    weights: Annotated[str, one_of(CHOICES["weights"][1:])]
    outputs: Annotated[str, one_of(CHOICES["outputs"][1:])]
    guard: Annotated[float, Meta(gt=0, le=1.7976931348623157e308, title="a finite number above 0")]


class Tool(TypedDict):
    """What wrote a bundle, and the options of the export.

    - ``name``: the program.
    - ``version``: its version, as it says itself.
    - ``profile``: the consumer that the files were made for (--for).
    - ``weights``: what weights were rounded to and are kept in (--dtype, --quantize).
    - ``batch``: for how many agents its .onnx and .tflite are (--batch); without it, for any number.
    - ``code``: how source code was written, where not as usual.
    - ``bake``: what of the interface its graph computes beside what the source does (--bake).
    """

    name: Text
    version: Text
    profile: NotRequired[Text]
    weights: NotRequired[Literal["float16", "int8"]]
    batch: NotRequired[Annotated[int, Meta(ge=1, le=2**63 - 1)]]
    code: NotRequired[CodeSection]
    bake: NotRequired[Literal["actions"]]


class Preprocess(TypedDict):
    """What must be done to an image before it is fed.

    - ``layout``: the order of its axes.
    - ``range``: lowest and highest value.
    - ``from_bytes``: how bytes of 0 to 255 become such values.
    """

    layout: Annotated[str, one_of(("NHWC", "NCHW"))]
    range: Annotated[list[Number], Meta(min_length=2, max_length=2)]
    from_bytes: Text


class ContractHead(Struct, frozen=True):
    """What a contract says beside the policy's signature.

    - ``name``: the policy's name, which its files have.
    - ``source``: where it came from, and how the source is run to verify again.
    - ``tool``: what wrote the bundle, and the options of the export.
    - ``files``: the bundle's files, by path.
    """

    name: _Name
    source: Origin
    tool: Tool
    files: Mapping[Text, FileEntry] = field(default_factory=dict)


class Contract(Struct, frozen=True):
    """What is agreed on a policy, the same in every format; ``files`` is empty in the copy that an artefact embeds."""

    name: str
    signature: PolicySignature
    origin: Origin
    source: SourceMap
    tool: Mapping[str, Any]
    files: Mapping[str, FileEntry] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<Contract of {self.name!r} from {self.origin.path!r}: {self.signature.flow}>"

    def to_dict(self) -> dict[str, Any]:
        """As in policy.json, or as embedded where there are no files."""
        files = {path: entry.to_dict() for path, entry in self.files.items()}
        return {
            "schema": SCHEMA,
            "name": self.name,
            **self.signature.to_dict(),
            "source": {**self.origin.to_dict(), **self.source.to_dict()},
            **({"files": files} if files else {}),
            "tool": dict(self.tool),
        }

    def compact(self) -> str:
        """JSON on one line, for embedding."""
        return json.dumps(self.to_dict(), separators=(",", ":"), ensure_ascii=True, allow_nan=False)


def safe_name(name: str) -> str:
    """A name for files and folders: characters outside [A-Za-z0-9._-] become ``-``."""
    cleaned = re.sub(r"[^A-Za-z0-9._-]", "-", name)
    return cleaned if cleaned.strip(".") else "policy"


def json_of(text: str | bytes) -> Any:
    """What JSON text says.

    Raises FieldError, too where an object has a key twice: readers differ in which of the two they take.
    """
    try:
        return loads(text, parse_constant=_no_number, parse_float=_finite, object_pairs_hook=_object)
    except FieldError:
        raise
    except (ValueError, RecursionError) as error:
        raise FieldError(WHOLE, f"is not JSON ({error})"[:200]) from error


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        counts = Counter(key for key, _ in pairs)
        ((twice, _),) = counts.most_common(1)
        raise FieldError(WHOLE, f"has {twice[:80]!r} twice in one object")
    return made


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is not a JSON number")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]} is beyond float64")
    return value


def parse(content: Any) -> Contract:
    """The contract in what JSON said. Raises FieldError that names the field."""
    if not isinstance(content, Mapping):
        raise FieldError(WHOLE, "must be an object")
    if content.get("schema") != SCHEMA:
        raise FieldError("schema", f"is {str(content.get('schema'))[:20]!r}, and this version reads {SCHEMA}")
    head: ContractHead = read(content, ContractHead)
    signature = parse_signature(content)
    for path in head.files:
        _check_path(path)
    source = parse_source_map(content["source"], signature)
    return Contract(head.name, signature, head.source, source, dict(head.tool), dict(head.files))


def parse_signature(content: Any) -> PolicySignature:
    """The part of a contract that describes the policy. Raises FieldError."""
    if not isinstance(content, Mapping):
        raise FieldError(WHOLE, "must be an object")
    apart = ("preprocess", "labels", "interface")
    kept = {key: value for key, value in content.items() if key not in apart}
    found: PolicySignature = read(kept, PolicySignature)
    inputs = _check_specs(found.inputs, "inputs", INPUT_ROLES, found.branches)
    outputs = _check_specs(found.outputs, "outputs", _OUTPUT_ROLES, found.branches)
    _check_sizes(found)
    _check_heads(found.action_space, outputs)
    named = [s.name for s in inputs]
    preprocess = read(content.get("preprocess", {}), dict[Text, Preprocess], "preprocess")
    for name, entry in preprocess.items():
        if name not in named:
            raise FieldError("preprocess", f"names {name!r}, which is not an input")
        low, high = entry["range"]
        if low >= high:
            raise FieldError(f"preprocess.{name}.range", "does not go up")
    memory = found.memory
    if memory is not None:
        for given, key, names in ((memory.input, "input", named), (memory.output, "output", [s.name for s in outputs])):
            _check_named(given, f"memory.{key}", names)
            for number, pair in enumerate(memory.others):
                _check_named(pair[key == "output"], f"memory.others[{number}]", names)
    try:
        labels = parse_labels(content.get("labels"))
    except ValueError as error:
        raise FieldError("labels", str(error)) from error
    interface = parse_interface(content.get("interface"), named)
    return replace(found, inputs=inputs, outputs=outputs, preprocess=preprocess, labels=labels, interface=interface)


def parse_source_map(content: Any, signature: PolicySignature) -> SourceMap:
    """How the source is run, with the feeds and fetches of ``signature``. Raises FieldError."""
    if not isinstance(content, Mapping):
        raise FieldError("source", "must be an object")
    apart = ("feeds", "fetches", "fixed")
    kept = {key: value for key, value in content.items() if key not in apart}
    found: SourceMap = read(kept, SourceMap, "source")
    unknown = found.parts.keys() - {s.name for s in (*signature.inputs, *signature.outputs)}
    if unknown:
        raise FieldError("source.parts", f"names {min(unknown)!r}, which is not an input or output")
    for name, parts in found.parts.items():
        for number, part in enumerate(parts):
            if part.shape.count(None) != 1:
                raise FieldError(f"source.parts.{name}[{number}].shape", "must have one batch axis")
    arrays = read(content.get("fixed", {}), dict[Text, _Array], "source.fixed")
    return replace(
        found,
        feeds=sources(signature.inputs, found.parts),
        fetches=sources(signature.outputs, found.parts),
        fixed={name: _array(entry, f"source.fixed.{name}.value") for name, entry in arrays.items()},
    )


# ------------------------------------------------------------------ tensors


class Normal(Struct, frozen=True, tag_field="kind", tag="normal"):
    """Numbers about a mean.

    - ``mean``, ``std``: one for all, or one for each number of the input.
    - ``clip``: at how many deviations the policy cuts them off; missing: nowhere.
    """

    mean: Number | list[Number]
    std: Number | list[Number]
    clip: Number | None = None


class Uniform(Struct, frozen=True, tag_field="kind", tag="uniform"):
    """Numbers between two.

    - ``low``, ``high``: the lowest and the highest.
    """

    low: Number
    high: Number


class Integer(Struct, frozen=True, tag_field="kind", tag="integer"):
    """Whole numbers, both ends included.

    - ``low``, ``high``: one for all, or one for each number of the input; None where any integer goes.
    - ``clipped``: what is higher is taken as ``high``, as a step beyond the end of a motion; missing where it is not.
    """

    low: _Id | list[_Id | None] | None = None
    high: _Id | list[_Id | None] | None = None
    clipped: bool | None = None


class Mask(Struct, frozen=True, tag_field="kind", tag="mask"):
    """A mask's numbers.

    - ``allowed``: that of an action that is allowed.
    - ``forbidden``: that of one that is not.
    """

    allowed: Annotated[int, Meta(ge=0, le=1)]
    forbidden: Annotated[int, Meta(ge=0, le=1)]


_Id = Annotated[int, Meta(ge=-(2**31), le=2**31 - 1)]
Distribution = Normal | Uniform | Integer | Mask
#: Fields of a distribution that are missing where they are None.
_OPTIONAL = ("clip", "clipped")


def _check_specs(
    specs: tuple[TensorSpec, ...], key: str, roles: Sequence[Role], branches: tuple[int, ...]
) -> tuple[TensorSpec, ...]:
    """Inputs or outputs that are whole: names, roles, ranks, distributions, one entry per action where that is so."""
    if len({s.name for s in specs}) < len(specs):
        raise FieldError(key, "has two tensors of one name")
    total = sum(branches)
    for number, spec in enumerate(specs):
        role, shape, place = spec.role, spec.shape, f"{key}[{number}]"
        _check_named(role, f"{place}.role", roles)
        if len(shape) not in _RANKS.get(role, range(33)):
            raise FieldError(f"{place}.shape", f"has {len(shape)} axes, which {role.value} cannot have")
        if role in (Role.MASKS, Role.LOG_PROBS, Role.PROBS) and total and shape[-1] not in (None, total):
            raise FieldError(f"{place}.shape", f"is not as wide as the branches, which have {total} actions")
        if role in (Role.MASKS, Role.PREV_ACTION) and (shape[-1] or 0) > _MOST_ACTIONS:
            raise FieldError(f"{place}.shape", f"has more than {_MOST_ACTIONS} actions")
    return tuple(_with_distribution(spec, f"{key}[{number}].distribution") for number, spec in enumerate(specs))


def _check_named(given: str | None, place: str, known: Sequence[str]) -> None:
    if given is not None and given not in known:
        raise FieldError(place, f"is {str(given)[:80]!r}, and none of {', '.join(known)}")


def _check_sizes(found: PolicySignature) -> None:
    if sum(math.prod(n for n in s.shape if n is not None) for s in found.inputs) > _MOST_FED:
        raise FieldError("inputs", f"has more than {_MOST_FED} numbers for an agent")
    if sum(found.branches) > _MOST_ACTIONS:
        raise FieldError("branches", f"has more than {_MOST_ACTIONS} actions")


def _check_heads(space: str, outputs: tuple[TensorSpec, ...]) -> None:
    heads = outputs[: 2 if space == "hybrid" else 1]
    if len(heads) < (2 if space == "hybrid" else 1) or not all(head.shape for head in heads):
        raise FieldError("outputs", "lacks an action")
    if space == "hybrid" and len({head.is_continuous for head in heads}) < 2:
        raise FieldError("outputs", "lacks the continuous or the discrete action of a hybrid")


def _with_distribution(spec: TensorSpec, place: str) -> TensorSpec:
    """With what its kind says, and nothing else: what is shown and drawn from it was looked at."""
    if spec.distribution is None:
        return spec
    found: Distribution = read(spec.distribution, Distribution, place)
    width = spec.shape[-1] if spec.shape else 1
    if isinstance(found, Normal):
        for key, values in (("mean", found.mean), ("std", found.std)):
            if isinstance(values, list) and len(values) not in (1, width):
                raise FieldError(f"{place}.{key}", f"has {len(values)} numbers, and the input {width}")
    if isinstance(found, Integer):
        _check_ids(found, spec.shape[-1] if len(spec.shape) > 1 else 1, place)
    made: dict[str, Any] = to_builtins(found)
    return replace(spec, distribution={k: v for k, v in made.items() if k not in _OPTIONAL or v is not None})


def _check_ids(found: Integer, width: int | None, place: str) -> None:
    """Raise FieldError unless bounds are pairs that go up, one for each number of the input where they are lists."""
    low, high = found.low, found.high
    for key, bounds in (("low", low), ("high", high)):
        if isinstance(bounds, list) and len(bounds) != width:
            raise FieldError(f"{place}.{key}", f"has {len(bounds)} numbers, and the input {width}")
    if isinstance(low, list) != isinstance(high, list):
        raise FieldError(f"{place}.high", "must be a list where low is one, and a number where it is one")
    lows, highs = (bounds if isinstance(bounds, list) else [bounds] for bounds in (low, high))
    for number, (least, most) in enumerate(zip(lows, highs, strict=True)):
        at = path_text((number,)) if isinstance(high, list) else ""
        if (least is None) != (most is None) or (least is not None and most is not None and most < least):
            raise FieldError(f"{place}.high{at}", f"must be an integer from {least} to {2**31 - 1}")


# ------------------------------------------------------------------ the source


class _Array(Struct, frozen=True):
    """An array as JSON has it."""

    dtype: Dtype
    value: Any


def _array(entry: _Array, place: str) -> np.ndarray:
    try:
        value = np.array(entry.value)
        if value.size <= _MOST_FIXED and value.dtype.kind in "biuf":
            return value.astype(np.dtype(entry.dtype))
    except (ValueError, TypeError, OverflowError) as error:
        raise FieldError(place, "must be an array of numbers") from error
    raise FieldError(place, "must be an array of numbers")


# ------------------------------------------------------------------ files


def _check_path(path: str) -> None:
    """Raise FieldError unless it is a path inside the bundle in its normal form, on every system."""
    parts, place = PurePosixPath(path).parts, f"files.{path}"
    if path != "/".join(parts) or not parts or {"..", "/"} & {*parts} or any(c in path for c in '\\:<>"|?*'):
        raise FieldError(place, "names a file outside of the bundle, or one that not every system can have")
    if path in (POLICY, PARITY):
        raise FieldError(place, "is not a file of an artefact")
