"""Logs of an agent read: ``.npz``, ``.csv`` or ``.jsonl``, as docs/tasks/field-logs.md describes them.

A log is data: arrays of numbers, text that is parsed as numbers, JSON. Nothing of it is executed. Names are the
policy's own, those of its source, or a role's ("masks", "memory"); a policy with one observation takes ``observation``.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TextIO

import numpy as np

from export_model.exporter.logs.recording import Array, Recording, links
from export_model.exporter.logs.replay import complete
from export_model.exporter.verify.golden import read_arrays
from export_model.signatures.bounded import loads
from export_model.signatures.errors import UsageError
from export_model.signatures.ids import check_ids
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature, TensorSpec

#: What a log may say beside the policy's tensors: which agent and episode a step is of, and whether it ends there.
AGENT, EPISODE, DONE = "agent", "episode", "done"
#: Read and left alone.
IGNORED = ("step", "time", "timestamp", "reward")
#: Words for an input or output, where the policy has one of that role.
WORDS: Mapping[str, tuple[Role, ...]] = {
    "observation": (Role.VECTOR, Role.VISUAL, Role.ENTITIES),
    "obs": (Role.VECTOR, Role.VISUAL, Role.ENTITIES),
    "masks": (Role.MASKS,),
    "memory": (Role.MEMORY_IN,),
    "previous_action": (Role.PREV_ACTION,),
    "noise": (Role.NOISE,),
    "memory_out": (Role.MEMORY_OUT,),
    "value": (Role.VALUE,),
}
#: A log may be so large, and have so many steps.
MAX_LOG_BYTES, MAX_STEPS = 1 << 31, 10_000_000
_COLUMN = re.compile(r"(.+?)(?:\[(\d{1,6})\]|\.(\d{1,6}))?")


def read_recording(path: Path, signature: PolicySignature) -> Recording:
    """The steps of a log. Raises UsageError, with the column's name, on what does not fit the policy."""
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise log_error(path, "its name must end in .npz, .csv or .jsonl", fix="numpy.savez(FILE, **arrays), or CSV")
    try:
        size = path.stat().st_size
    except OSError as error:
        raise log_error(path, "cannot be read", why=error.strerror or str(error)) from error
    if size > MAX_LOG_BYTES:
        raise log_error(path, f"has {size} bytes", why=f"at most {MAX_LOG_BYTES} are read", fix="cut it into parts")
    arrays, rounding = reader(path)
    return _recording(path, arrays, rounding, signature)


def log_error(path: Path, what: str, *, why: str | None = None, fix: str | None = None) -> UsageError:
    """The error for a log that cannot be used."""
    return UsageError(f"--log: {what}", where=str(path), why=why, fix=fix)


def _recording(
    path: Path, arrays: Mapping[str, Array], rounding: Mapping[str, Array], signature: PolicySignature
) -> Recording:
    specs = _known_names(signature)
    inputs: dict[str, Array] = {}
    outputs: dict[str, Array] = {}
    own: dict[str, Array] = {}
    halves: dict[str, Array] = {}
    for name, array in arrays.items():
        if name in (AGENT, EPISODE, DONE):
            own[name] = _numbers_of_steps(path, name, array)
        elif name not in IGNORED:
            spec = specs.get(name.removesuffix(":0"))
            if spec is None:
                known = ", ".join([*dict.fromkeys(s.name for s in specs.values()), AGENT, EPISODE, DONE, *IGNORED])
                raise log_error(path, f"{name!r} is not a column of this policy", fix=f"the columns are {known}")
            taken = inputs if spec in signature.inputs else outputs
            if spec.name in taken:
                raise log_error(path, f"{name!r} stands for {spec.name!r}, which is in the log already")
            taken[spec.name] = _fit_to_spec(path, name, spec, array, signature)
            halves[spec.name] = rounding.get(name, np.zeros(1))
    steps = _count_steps(path, {**inputs, **outputs, **own})
    if not outputs:
        known = ", ".join(s.name for s in signature.outputs)
        raise log_error(path, "holds nothing that the policy answers", fix=f"log an action: one of {known}")
    missing = [s.name for s in signature.inputs if s.role not in _DERIVED and s.name not in inputs]
    if missing:
        raise log_error(path, f"the input {missing[0]!r} is missing", fix="log every observation of every step")
    agent = own.get(AGENT, np.zeros(steps, np.int64))
    episode = own.get(EPISODE, np.zeros(steps, np.int64))
    before, last = links(agent, np.zeros(steps, bool))
    known_last = last >= 0
    begins = ~known_last
    begins[known_last] |= episode[known_last] != episode[last[known_last]]
    if DONE in own:
        begins[known_last] |= own[DONE][last[known_last]] != 0
    before = np.where(begins, -1, last)
    pair = signature.recurrence
    return Recording(
        inputs=complete(inputs, outputs, before, signature),
        outputs=outputs,
        before=before,
        last=last,
        rounding=halves,
        episodes=int(begins.sum()),
        ignored=tuple(name for name in arrays if name in IGNORED),
        logged=frozenset(inputs),
        chained=pair is not None and pair[0] not in inputs,
        episode=episode,
        agent=agent,
    )


#: Inputs that a log may leave out (exporter/logs/replay.py).
_DERIVED = (Role.MEMORY_IN, Role.NOISE, Role.MASKS, Role.PREV_ACTION)


def _known_names(signature: PolicySignature) -> dict[str, TensorSpec]:
    """Every name that a tensor may be logged under; the policy's own win."""
    found: dict[str, TensorSpec] = {}
    for word, roles in WORDS.items():
        alike = [s for s in (*signature.inputs, *signature.outputs) if s.role in roles]
        if len(alike) == 1:
            found[word] = alike[0]
    heads = [h.spec for h in signature.heads]
    found |= {"action": heads[0], "actions": heads[0]} if len(heads) == 1 else {}
    if len(heads) == 2:
        found |= {"continuous": heads[0], "discrete": heads[1]}
    both = (*signature.outputs, *signature.inputs)
    found |= {s.source.removesuffix(":0"): s for s in both if isinstance(s.source, str)}
    return found | {s.name: s for s in both}


def _fit_to_spec(path: Path, name: str, spec: TensorSpec, array: Array, signature: PolicySignature) -> Array:
    """``array`` as the replay takes it; choices as int64 [steps, branches]."""
    if not array.size:
        raise log_error(path, f"holds no steps of {name!r}", fix="log at least one step")
    if array.dtype.kind not in "fiub":
        raise log_error(path, f"{name!r} must hold numbers", why=f"it is {array.dtype}")
    if array.dtype.kind == "f":
        odd = np.argwhere(~np.isfinite(array.reshape(len(array), -1)))
        if len(odd):
            row, column = odd[0].tolist()
            raise log_error(
                path, f"{name}[{column}] is not a finite number at step {row}", fix="leave that episode out"
            )
    choices = _choices(spec, array, signature)
    if choices is not None:
        return choices
    wanted = (1,) if len(spec.shape) == 1 else tuple(n for n in spec.shape[1:])
    free = array.shape[1:] if array.ndim == len(wanted) + 1 else (1,) * len(wanted)
    shape = (len(array), *(m if n is None else n for n, m in zip(wanted, free, strict=True)))
    if array.size != int(np.prod(shape)):
        text = ", ".join(["steps", *("any" if n is None else str(n) for n in wanted)])
        raise log_error(path, f"{name!r} has the shape {list(array.shape)}", why=f"the policy has [{text}]")
    array = array.reshape(shape)
    if spec not in signature.inputs:
        return array.astype(np.float64)
    if spec.role is Role.VISUAL and array.dtype == np.uint8:
        low, high = signature.preprocess.get(spec.name, {}).get("range") or (0, 255)
        array = array.astype(np.float32) * np.float32((high - low) / 255) + np.float32(low)
    found = np.ascontiguousarray(array.astype(spec.dtype))
    found = found.reshape(len(found)) if len(spec.shape) == 1 else found
    check_ids(spec, found)
    return found


def _choices(spec: TensorSpec, array: Array, signature: PolicySignature) -> Array | None:
    """int64 [steps, branches] where ``array`` is what was chosen, not the numbers it was chosen by."""
    head = next((h for h in signature.heads if spec in (h.spec, h.plain)), None)
    if head is None or head.is_continuous:
        return None
    branches = head.branches or (1,)
    flat = array.reshape(len(array), -1)
    if flat.shape[1] != len(branches) or (flat.dtype.kind == "f" and (flat != np.round(flat)).any()):
        return None
    return flat.astype(np.int64)


def _numbers_of_steps(path: Path, name: str, array: Array) -> Array:
    if not array.size:
        raise log_error(path, f"holds no steps of {name!r}", fix="log at least one step")
    flat = array.reshape(len(array), -1)
    if flat.shape[1] != 1 or flat.dtype.kind not in "fiub" or not np.isfinite(flat).all():
        raise log_error(path, f"{name!r} must have one whole number for each step")
    if (flat != np.round(flat)).any():
        raise log_error(path, f"{name!r} must have one whole number for each step")
    return flat[:, 0].astype(np.int64)


def _count_steps(path: Path, arrays: Mapping[str, Array]) -> int:
    counts = {name: len(array) for name, array in arrays.items()}
    if not counts or not max(counts.values()):
        raise log_error(path, "holds no steps", fix="log at least one step")
    if len(set(counts.values())) > 1:
        said = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise log_error(path, "its columns must have the same number of steps", why=said)
    steps = max(counts.values())
    if steps > MAX_STEPS:
        raise log_error(path, f"has {steps} steps", why=f"at most {MAX_STEPS} are read", fix="cut it into parts")
    return steps


def _read_npz(path: Path) -> tuple[dict[str, Array], dict[str, Array]]:
    arrays = read_arrays(path, "--log")
    half = {n: np.asarray([_half_digit(a.dtype)]) for n, a in arrays.items() if a.dtype.kind == "f"}
    return {n: a if a.ndim else a.reshape(1) for n, a in arrays.items()}, half


def _half_digit(dtype: np.dtype) -> float:
    """What float16 cut off a number of about 1; nothing of float32."""
    return float(np.finfo(dtype).eps) / 2 if dtype.itemsize < 4 else 0.0


def _read_csv(path: Path) -> tuple[dict[str, Array], dict[str, Array]]:
    with _text_of(path) as file:
        reader = csv.reader(file)
        try:
            head = [text.strip() for text in next(reader, [])]
            rows = [row for row in reader if row]
        except csv.Error as error:
            raise log_error(path, "cannot be read as CSV", why=str(error)) from error
    if not head or not rows:
        raise log_error(path, "holds no steps", fix="a line of names, then a line for each step")
    wrong = next((number for number, row in enumerate(rows, 2) if len(row) != len(head)), None)
    if wrong is not None:
        raise log_error(
            path, f"line {wrong} has {len(rows[wrong - 2])} fields", why=f"the first line names {len(head)}"
        )
    columns: dict[str, list[tuple[int, Array, float]]] = {}
    for place, text in enumerate(head):
        found = _COLUMN.fullmatch(text)
        if found is None:
            raise log_error(path, f"column {place + 1} has no name")
        number = found[2] or found[3]
        values = [row[place] for row in rows]
        array = _parse_column(path, text, values)
        columns.setdefault(found[1], []).append((int(number or 0), array, _half_decimal(values)))
    arrays, halves = {}, {}
    for name, parts in columns.items():
        parts.sort(key=lambda part: part[0])
        if [part[0] for part in parts] != list(range(len(parts))):
            missing = next(i for i in range(len(parts) + 1) if i not in {p[0] for p in parts})
            raise log_error(path, f"{name}[{missing}] is missing", why=f"the columns {name}[…] must count from 0 on")
        arrays[name] = np.stack([part[1] for part in parts], axis=1)
        halves[name] = np.asarray([part[2] for part in parts])
    return arrays, halves


def _text_of(path: Path) -> TextIO:
    return path.open(encoding="utf-8-sig", errors="replace", newline="")


_TRUTHS = {"true": "1", "false": "0"}


def _parse_column(path: Path, name: str, texts: Sequence[str]) -> Array:
    try:
        return np.asarray(texts, np.float64)
    except ValueError:
        pass
    for number, text in enumerate(texts):
        plain = text.strip().lower()
        try:
            float(_TRUTHS.get(plain, plain))
        except ValueError as error:
            raise log_error(path, f"{name!r} must hold numbers", why=f"line {number + 2} has {text[:40]!r}") from error
    return np.asarray([float(_TRUTHS.get(t.strip().lower(), t)) for t in texts])


def _half_decimal(texts: Sequence[str]) -> float:
    """Half a unit of the last decimal that any of ``texts`` has; 0 where they are whole, or written exactly."""
    most = 0
    for text in texts:
        mantissa = text.strip().lower()
        if "e" in mantissa:
            return 0.0
        _, point, decimals = mantissa.partition(".")
        most = max(most, len(decimals) if point else 0)
    return 0.5 * 10.0**-most if 0 < most < 7 else 0.0


def _read_jsonl(path: Path) -> tuple[dict[str, Array], dict[str, Array]]:
    steps: list[Mapping[str, object]] = []
    for number, line in _lines(path):
        try:
            step = loads(line)
        except (ValueError, RecursionError) as error:
            raise log_error(path, f"line {number} is not JSON", why=str(error)) from error
        if not isinstance(step, Mapping):
            raise log_error(path, f'line {number} must be an object, such as {{"observation": […], "action": […]}}')
        if steps and step.keys() != steps[0].keys():
            odd = sorted(map(str, step.keys() ^ steps[0].keys()))[0]
            why = f"line {number} differs from the first"
            raise log_error(path, f"{odd!r} must be in every step or in none", why=why)
        steps.append(step)
    if not steps:
        raise log_error(path, "holds no steps", fix='an object on each line: {"observation": […], "action": […]}')
    arrays = {}
    for name in steps[0]:
        try:
            array = np.asarray([step[name] for step in steps])
        except (ValueError, OverflowError) as error:
            raise log_error(path, f"{name!r} must have the same shape in every step", why=str(error)) from error
        if array.dtype.kind not in "fiub":
            raise log_error(path, f"{name!r} must hold numbers", why=f"it is {array.dtype}")
        arrays[str(name)] = array
    halves = {n: np.asarray([_half_of(a)]) for n, a in arrays.items() if a.dtype.kind == "f"}
    return arrays, halves


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    with _text_of(path) as file:
        for number, line in enumerate(file, 1):
            if line.strip():
                yield number, line


def _half_of(array: Array) -> float:
    """As ``_half_decimal``, from the numbers: the fewest decimals that give the first thousand of them."""
    few = array.reshape(-1)[:1000]
    for decimals in range(1, 7):
        if np.array_equal(np.round(few, decimals), few):
            return 0.0 if np.array_equal(np.round(few), few) else 0.5 * 10.0**-decimals
    return 0.0


_READERS: Mapping[str, Callable[[Path], tuple[dict[str, Array], dict[str, Array]]]] = {
    ".npz": _read_npz,
    ".csv": _read_csv,
    ".jsonl": _read_jsonl,
}
