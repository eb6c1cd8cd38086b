"""What lies in a folder that training left: behaviors, their final exports, and what was kept on the way.

ML-Agents' layouts (docs: mlagents-contract §1.1):

- 0.1 to 0.5: ``models/<run>/`` has raw_graph_def.pb, model-<step>.cptk.* and <env>.bytes: the run is one folder;
- 0.6: ``models/<run>/<brain>/`` has graph and checkpoints, ``models/<run>/<brain>.bytes`` is the export;
- 0.7 to 0.16: the same, with ``<brain>/frozen_graph_def.pb`` and ``<brain>.nn`` (``.onnx``) as exports;
- 0.17 and later: ``results/<run>/<behavior>/``, from 0.19 on with ``<behavior>-<step>.nn`` (``.onnx``, ``.pt``) in it.

So a folder is either one behavior's, or holds a folder and files per behavior. Only names are looked at here. The text
file ``checkpoint`` is not read: it may be missing, or hold the paths of another machine.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from msgspec import Struct
from msgspec.structs import replace

RAW_GRAPH, FROZEN_GRAPH, LIST = "raw_graph_def.pb", "frozen_graph_def.pb", "checkpoint"
#: Final exports, the one that is taken first: graphs hold most, and an ONNX has a runtime of its own to be verified in.
FINALS = ("frozen", ".bytes", ".pb", ".onnx", ".nn")
#: What training kept at a step, the one that is taken first.
STEPPED = (".index", ".onnx", ".nn", ".pt")
_STEP = re.compile(r"(?P<name>.+)-(?P<step>\d{1,18})(?:\.[A-Za-z]\w*)?")
_NOT_EXPORTS = (RAW_GRAPH, "saved_model.pb", "keras_metadata.pb", "fingerprint.pb")


class KeptStep(Struct, frozen=True):
    """What training kept at a step: an export, or a checkpoint's index (``prefix`` is its path without ``.index``)."""

    path: Path
    step: int | None

    @property
    def suffix(self) -> str:
        """What kind of file it is."""
        return self.path.suffix

    @property
    def prefix(self) -> Path:
        """What TensorFlow calls a checkpoint."""
        return self.path.with_suffix("")

    @property
    def label(self) -> str:
        """What people call it."""
        return self.prefix.name if self.suffix == ".index" else self.path.name


class Behavior(Struct, frozen=True):
    """One policy of a run, in the forms it was kept in."""

    name: str
    folder: Path
    finals: tuple[Path, ...] = ()
    kept: tuple[KeptStep, ...] = ()

    @property
    def steps(self) -> list[int]:
        """The steps that there are."""
        return sorted({k.step for k in self.kept if k.step is not None})


def step_of(name: str) -> tuple[str, int | None]:
    """``"model-1000.cptk"`` as ``("model", 1000)``; the name itself and None where there is no step."""
    match = _STEP.fullmatch(name)
    return (match["name"], int(match["step"])) if match else (name, None)


def checkpoints(folder: Path) -> list[KeptStep]:
    """The checkpoints in a folder, the newest last."""
    found = [KeptStep(p, step_of(p.stem)[1]) for p in _files(folder) if p.suffix == ".index"]
    return sorted(found, key=lambda k: (-1 if k.step is None else k.step, k.path.name))


def graph_of(prefix: Path) -> Path | None:
    """The graph of a checkpoint: its own ``.meta``, else the folder's raw_graph_def.pb."""
    for path in (prefix.with_name(prefix.name + ".meta"), prefix.with_name(RAW_GRAPH)):
        if path.is_file():
            return path
    return None


def behaviors(folder: Path) -> list[Behavior]:
    """The policies in a folder, by name; empty where it is none that training left. Raises OSError."""
    own = _behavior(folder)
    if own is not None:
        return [own]
    files = _files(folder)
    inner = [b for b in map(_behavior, _folders(folder)) if b is not None]
    found = {b.name: b for b in inner}
    names = {p.stem for p in files if _final(p) is not None}
    for path in files:
        if _final(path) is None:
            continue
        stem, step = step_of(path.stem)
        if step is not None and path.suffix in STEPPED and (stem in found or stem in names):
            known = found.get(stem, Behavior(stem, folder))
            found[stem] = replace(known, kept=(*known.kept, KeptStep(path, step)))
        else:
            known = found.get(path.stem, Behavior(path.stem, folder))
            found[path.stem] = replace(known, finals=(*known.finals, path))
    return [found[name] for name in sorted(found)]


def unread_folders(folder: Path) -> list[Path]:
    """Folders beside a run's behaviors that hold exports and are none of them. Raises OSError."""
    if _behavior(folder) is not None:
        return []
    return [f for f in _folders(folder) if _behavior(f) is None and any(_final(p) is not None for p in _files(f))]


def runs(folder: Path) -> list[Path]:
    """Folders inside, for advice: those that hold a policy themselves. Not all of a home folder is looked through."""
    found = []
    for sub in _folders(folder)[:100]:
        with suppress(OSError):
            if (sub / "policy.json").is_file() or behaviors(sub):
                found.append(sub)
    return found


def best(finals: Iterable[Path]) -> list[Path]:
    """The final exports of the kind that goes before the others."""
    ranked = sorted(((FINALS.index(_final(p) or ""), p) for p in finals), key=lambda entry: entry[0])
    return [p for rank, p in ranked if rank == ranked[0][0]]


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))


def _folders(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))


def _final(path: Path) -> str | None:
    """Which final export a file is by its name, None where it is none."""
    if path.name == FROZEN_GRAPH:
        return "frozen"
    return path.suffix if path.suffix in FINALS and path.name not in _NOT_EXPORTS else None


def _as_step(path: Path, behavior: str) -> int | None:
    """The step of an export that was kept on the way (``<behavior>-<step>.onnx``), None where it is a final one."""
    stem, step = step_of(path.stem)
    return step if path.suffix in STEPPED and (stem == behavior or _has_checkpoint(path)) else None


def _has_checkpoint(path: Path) -> bool:
    return path.with_name(path.stem + ".ckpt.index").exists() or path.with_name(path.stem + ".pt").exists()


def _behavior(folder: Path) -> Behavior | None:
    """The behavior whose folder it is: it has a checkpoint, a graph, or exports kept at steps; else None."""
    name, files = folder.resolve().name, _files(folder)
    steps = {p: step for p in files if (step := _as_step(p, name)) is not None}
    if not steps and not any(p.name in (RAW_GRAPH, FROZEN_GRAPH) or p.suffix in (".index", ".pt") for p in files):
        return None
    kept = [KeptStep(p, step) for p, step in steps.items() if p.suffix in (".onnx", ".nn")]
    kept += [KeptStep(p, step_of(p.stem)[1]) for p in files if p.suffix == ".pt"]
    finals = tuple(p for p in files if _final(p) is not None and p not in steps)
    return Behavior(name, folder, finals, (*checkpoints(folder), *kept))
