"""The contract: what policy.json says, and the copy that every artefact embeds. Only here is it parsed and validated.

A contract comes from a file, so it is not trusted: types, ranges, names that can be printed, keys of files that stay
inside the bundle. What is wrong is said with the field that it stands in (``outputs[1].shape``). Keys that are not
known are left alone.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from msgspec import Struct, field

from signatures.bounded import loads
from signatures.code import CHOICES
from signatures.fields import Field, FieldError, without_none
from signatures.interface import parse_interface
from signatures.labels import parse_labels
from signatures.memories import SourcePart
from signatures.roles import INPUT_ROLES, Constant, Role
from signatures.spec import Memory, PolicySignature, SourceMap, TensorSpec, sources

POLICY, PARITY = "policy.json", "parity.json"
SCHEMA = 1
#: What an artefact calls the copy that it embeds: a node of a graph, a property of a model.
EMBEDDED = "export_model_contract"
#: Characters that may stand in a policy's name.
_NAME = re.compile(r"[A-Za-z0-9._-]{1,255}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
#: What tensors may be of.
DTYPES = (
    *("bool", "float16", "float32", "float64", "int8", "int16", "int32", "int64"),
    *("uint8", "uint16", "uint32", "uint64"),
)
_SPACES = ("continuous", "discrete", "hybrid")
_OUTPUT_ROLES = tuple(r.value for r in Role if r not in INPUT_ROLES)
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


class FileEntry(Struct, frozen=True):
    """One file of a bundle: the sha256 of its bytes (hexadecimal) and how many they are."""

    sha256: str
    size: int


class Origin(Struct, frozen=True):
    """Where a policy comes from: the source's base name and sha256, which model of it, how it was read."""

    path: str
    sha256: str
    model: str | None = None
    step: int | None = None
    sensors: tuple[tuple[int, ...], ...] = ()
    goals: tuple[int, ...] = ()
    activation: str | None = None
    normaliser: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """As in policy.json."""
        return without_none(
            path=self.path,
            sha256=self.sha256,
            model=self.model,
            step=self.step,
            sensors=[list(shape) for shape in self.sensors] or None,
            goals=list(self.goals) or None,
            activation=self.activation,
            normaliser=self.normaliser,
        )


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
        files = {path: {"sha256": entry.sha256, "bytes": entry.size} for path, entry in self.files.items()}
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
    """What JSON text says. Raises FieldError."""
    try:
        return loads(text, parse_constant=_no_number, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise FieldError("the whole", f"is not JSON ({error})"[:200]) from error


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is not a JSON number")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]} is beyond float64")
    return value


def parse(content: Any) -> Contract:
    """The contract in what JSON said. Raises FieldError that names the field."""
    whole = Field(content)
    if whole["schema"].value != SCHEMA:
        raise whole["schema"].error(f"is {str(whole['schema'].value)[:20]!r}, and this version reads {SCHEMA}")
    name = whole["name"]
    if not isinstance(name.value, str) or not _NAME.fullmatch(name.value) or not name.value.strip("."):
        raise name.error("is not the name of a policy")
    signature = parse_signature(whole)
    source, tool = whole["source"], whole["tool"]
    origin = Origin(
        path=source["path"].text(),
        sha256=_sha256(source["sha256"]),
        model=None if source["model"].missing else source["model"].text(blank=True),
        step=None if source["step"].missing else source["step"].integer(-(2**63)),
        sensors=tuple(tuple(n.integer(1) for n in shape.items(8)) for shape in source["sensors"].items(1000)),
        goals=tuple(n.integer(0) for n in source["goals"].items(1000)),
        activation=None if source["activation"].missing else source["activation"].text(),
        normaliser=None if source["normaliser"].missing else source["normaliser"].text(),
    )
    entries = whole["files"].members()
    files = {_key(p, e): FileEntry(_sha256(e["sha256"]), e["bytes"].integer(0)) for p, e in entries.items()}
    made = without_none(
        name=tool["name"].text(),
        version=tool["version"].text(),
        profile=None if tool["profile"].missing else tool["profile"].text(),
        weights=None if tool["weights"].missing else tool["weights"].one_of(("float16", "int8")),
        batch=None if tool["batch"].missing else tool["batch"].integer(1),
        code=None if tool["code"].missing else _code(tool["code"]),
        bake=None if tool["bake"].missing else tool["bake"].one_of(("actions",)),
    )
    return Contract(name.value, signature, origin, parse_source_map(source, signature), made, files)


def _code(said: Field) -> dict[str, Any]:
    """How source code was written, as far as it is not as usual."""
    words = {key: said[key].one_of(choices) for key, choices in CHOICES.items() if not said[key].missing}
    return words if said["guard"].missing else {**words, "guard": said["guard"].number()}


def parse_signature(whole: Field) -> PolicySignature:
    """The part of a contract that describes the policy. Raises FieldError."""
    inputs = _tensors(whole["inputs"], [r.value for r in INPUT_ROLES])
    outputs = _tensors(whole["outputs"], _OUTPUT_ROLES)
    space = whole["action_space"].one_of(_SPACES)
    _check_sizes(whole, inputs)
    heads = outputs[: 2 if space == "hybrid" else 1]
    if len(heads) < (2 if space == "hybrid" else 1) or not all(head.shape for head in heads):
        raise whole["outputs"].error("lacks an action")
    if space == "hybrid" and len({head.is_continuous for head in heads}) < 2:
        raise whole["outputs"].error("lacks the continuous or the discrete action of a hybrid")
    for key, specs in (("inputs", inputs), ("outputs", outputs)):
        _check_branches(whole, key, specs)
    named = {s.name: s for s in inputs}
    preprocess = {name: _preprocess(entry) for name, entry in whole["preprocess"].members().items()}
    if not preprocess.keys() <= named.keys():
        raise whole["preprocess"].error(f"names {min(preprocess.keys() - named.keys())!r}, which is not an input")
    try:
        labels = parse_labels(whole["labels"].value)
    except ValueError as error:
        raise whole["labels"].error(str(error)) from error
    return PolicySignature(
        inputs=inputs,
        outputs=outputs,
        family=whole["family"].text(),
        action_space=space,
        branches=tuple(n.integer(1, 2**31 - 1) for n in whole["branches"].items()),
        algorithm=None if whole["algorithm"].missing else whole["algorithm"].text(),
        memory=None if whole["memory"].missing else _memory(whole["memory"], inputs, outputs),
        preprocess=preprocess,
        constants={name: _constant(value) for name, value in whole["constants"].members().items()},
        notes=tuple(note.text() for note in whole["notes"].items()),
        labels=labels,
        interface=parse_interface(whole["interface"], list(named)),
    )


def parse_source_map(source: Field, signature: PolicySignature) -> SourceMap:
    """How the source is run, with the feeds and fetches of ``signature``. Raises FieldError."""
    parts = {name: tuple(_part(p) for p in given.items()) for name, given in source["parts"].members().items()}
    names = {s.name for s in (*signature.inputs, *signature.outputs)}
    if not parts.keys() <= names:
        raise source["parts"].error(f"names {min(parts.keys() - names)!r}, which is not an input or output")
    return SourceMap(
        feeds=sources(signature.inputs, parts),
        fetches=sources(signature.outputs, parts),
        fixed={name: _array(entry) for name, entry in source["fixed"].members().items()},
        batch_sizes={name: rank.integer(0, 1) for name, rank in source["batch_sizes"].members().items()},
        noise={name: shape.shape() for name, shape in source["noise"].members().items()},
        noise_kept=source["noise_kept"].truth(),
        branches=tuple(None if b.missing else b.text() for b in source["branches"].items()),
        rows=None if source["rows"].missing else source["rows"].integer(1),
        parts=parts,
    )


# ------------------------------------------------------------------ tensors


def _tensors(entries: Field, roles: Any) -> tuple[TensorSpec, ...]:
    found = tuple(_tensor(entry, roles) for entry in entries.items())
    names = [s.name for s in found]
    if len({*names}) < len(names):
        raise entries.error("has two tensors of one name")
    return found


def _check_sizes(whole: Field, inputs: tuple[TensorSpec, ...]) -> None:
    if sum(math.prod(n for n in s.shape if n is not None) for s in inputs) > _MOST_FED:
        raise whole["inputs"].error(f"has more than {_MOST_FED} numbers for an agent")
    if sum(n.integer(1, _MOST_ACTIONS) for n in whole["branches"].items()) > _MOST_ACTIONS:
        raise whole["branches"].error(f"has more than {_MOST_ACTIONS} actions")
    for entry, spec in zip(whole["inputs"].items(), inputs, strict=True):
        if spec.role in (Role.MASKS, Role.PREV_ACTION) and (spec.shape[-1] or 0) > _MOST_ACTIONS:
            raise entry["shape"].error(f"has more than {_MOST_ACTIONS} actions")


def _check_branches(whole: Field, key: str, specs: tuple[TensorSpec, ...]) -> None:
    """Raise FieldError unless masks and probabilities have one entry per action."""
    total = sum(n.value for n in whole["branches"].items())
    for entry, spec in zip(whole[key].items(), specs, strict=True):
        if spec.role in (Role.MASKS, Role.LOG_PROBS, Role.PROBS) and total and spec.shape[-1] not in (None, total):
            raise entry["shape"].error(f"is not as wide as the branches, which have {total} actions")


def _tensor(entry: Field, roles: Any) -> TensorSpec:
    shape, source, role = entry["shape"].shape(), entry["source"], Role(entry["role"].one_of(roles))
    if len(shape) not in _RANKS.get(role, range(33)):
        raise entry["shape"].error(f"has {len(shape)} axes, which {role.value} cannot have")
    return TensorSpec(
        entry["name"].text(),
        role,
        entry["dtype"].one_of(DTYPES),
        shape,
        tuple(s.text() for s in source.items())
        if isinstance(source.value, list)
        else None
        if source.missing
        else source.text(),
        None if entry["distribution"].missing else _distribution(entry["distribution"], shape),
    )


def _distribution(entry: Field, shape: tuple[int | None, ...]) -> dict[str, Any]:
    """What its kind says, and nothing else: what is shown and drawn from it was looked at."""
    kind = entry["kind"].one_of(("normal", "uniform", "integer", "mask"))
    if kind == "integer":
        return {"kind": kind, **_id_bounds(entry["low"], entry["high"], shape)}
    if kind == "uniform":
        return {"kind": kind, "low": entry["low"].number(), "high": entry["high"].number()}
    if kind == "normal":
        clip = {} if entry["clip"].missing else {"clip": entry["clip"].number()}
        return {"kind": kind, **{key: _statistics(entry[key], shape) for key in ("mean", "std")}, **clip}
    return {"kind": kind, **{key: entry[key].integer(0, 1) for key in ("allowed", "forbidden")}}


def _id_bounds(low: Field, high: Field, shape: tuple[int | None, ...]) -> dict[str, Any]:
    """The lowest and highest id, or one pair for each number of the input; None where any integer goes."""

    def pair(first: Field, last: Field) -> tuple[int | None, int | None]:
        if first.value is None and last.value is None:
            return None, None
        lowest = first.integer(-(2**31), 2**31 - 1)
        return lowest, last.integer(lowest, 2**31 - 1)

    if not isinstance(high.value, list):
        return dict(zip(("low", "high"), pair(low, high), strict=True))
    both = (low.items(_MOST_FED), high.items(_MOST_FED))
    for entry, found in zip((low, high), both, strict=True):
        if len(found) != (shape[-1] if len(shape) > 1 else 1):
            raise entry.error(f"has {len(found)} numbers, and the input {shape[-1] if len(shape) > 1 else 1}")
    pairs = [pair(*each) for each in zip(*both, strict=True)]
    return {"low": [p[0] for p in pairs], "high": [p[1] for p in pairs]}


def _statistics(entry: Field, shape: tuple[int | None, ...]) -> Any:
    """A number, or one for each number of the input."""
    if not isinstance(entry.value, list):
        return entry.number()
    found = [number.number() for number in entry.items(_MOST_FED)]
    if len(found) != 1 and (not shape or shape[-1] != len(found)):
        raise entry.error(f"has {len(found)} numbers, and the input {shape[-1] if shape else 1}")
    return found


def _preprocess(entry: Field) -> dict[str, Any]:
    entry["layout"].one_of(("NHWC", "NCHW"))
    low, high = (n.number() for n in _pair(entry["range"]))
    if low >= high:
        raise entry["range"].error("does not go up")
    layout, whole = entry["layout"].value, entry["range"].value
    return {"layout": layout, "range": list(whole), "from_bytes": entry["from_bytes"].text()}


def _pair(entry: Field) -> list[Field]:
    found = entry.items()
    if len(found) != 2:
        raise entry.error("must be a pair")
    return found


def _memory(entry: Field, inputs: tuple[TensorSpec, ...], outputs: tuple[TensorSpec, ...]) -> Memory:
    taken = None if entry["input"].missing else entry["input"].one_of([s.name for s in inputs])
    given = None if entry["output"].missing else entry["output"].one_of([s.name for s in outputs])
    layout = tuple(part.text() for part in entry["layout"].items())
    others = [] if entry["others"].missing else [_pair(pair) for pair in entry["others"].items()]
    pairs = tuple((a.one_of([s.name for s in inputs]), b.one_of([s.name for s in outputs])) for a, b in others)
    return Memory(entry["size"].integer(0, 2**31 - 1), taken, given, layout, pairs)


def _constant(value: Field) -> Constant:
    return [n.integer(-(2**63)) for n in value.items()] if isinstance(value.value, list) else value.number()


# ------------------------------------------------------------------ the source


def _part(entry: Field) -> SourcePart:
    shape = entry["shape"].shape()
    if shape.count(None) != 1:
        raise entry["shape"].error("must have one batch axis")
    return SourcePart(entry["tensor"].text(), shape)


def _array(entry: Field) -> np.ndarray:
    dtype = np.dtype(entry["dtype"].one_of(DTYPES))
    try:
        value = np.array(entry["value"].value)
        if value.size > _MOST_FIXED or value.dtype.kind not in "biuf":
            raise entry["value"].error("must be an array of numbers")
        return value.astype(dtype)
    except (ValueError, TypeError, OverflowError) as error:
        if isinstance(error, FieldError):
            raise
        raise entry["value"].error("must be an array of numbers") from error


# ------------------------------------------------------------------ files


def _sha256(entry: Field) -> str:
    if not isinstance(entry.value, str) or not _SHA256.fullmatch(entry.value):
        raise entry.error("must be a sha256 in hexadecimal")
    return entry.value


def _key(path: str, entry: Field) -> str:
    """A path inside the bundle in its normal form, on every system."""
    parts = PurePosixPath(path).parts
    if path != "/".join(parts) or not parts or {"..", "/"} & {*parts} or any(c in path for c in '\\:<>"|?*'):
        raise entry.error("names a file outside of the bundle, or one that not every system can have")
    if path in (POLICY, PARITY):
        raise entry.error("is not a file of an artefact")
    return path
