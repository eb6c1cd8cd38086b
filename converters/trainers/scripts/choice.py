"""Which script a state dictionary is of: by the names of its layers, by what its file is called, or as the user says.

Where the names fit several that compute different things, nothing is chosen: the readings are named, side by side.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct

from export_model.converters.trainers.scripts.table import CLEANRL, PPO_PYTORCH, SCRIPTS, Script, shape_of, width_of
from export_model.converters.trainers.trainer import Saved
from export_model.signatures.errors import SourceError, UsageError, suggestion

EXPORT_ONNX = "export the policy to ONNX in its own project (torch.onnx.export), and give that"
#: What a script calls its files: (maker, pattern of the file's name, pattern of its folder's, what it is).
_PLACES = (
    (CLEANRL, r".+\.cleanrl_model", r".*", "its file is a .cleanrl_model"),
    (CLEANRL, r".*", r".+__.+__\d+__\d+", "its folder is called as CleanRL calls its runs"),
    (PPO_PYTORCH, r"PPO_.+_\d+_\d+\.pth", r".*", "its file is called as PPO-PyTorch calls its checkpoints"),
)


class Known(Struct, frozen=True):
    """A state dictionary, and the scripts whose names it has, in the order of the table."""

    state: Mapping[Any, Any]
    scripts: tuple[Script, ...]


def known_state(value: Any) -> Known | None:
    """Return the policy's state dictionary in what was saved; None where no script has its names."""
    candidates = [value, *(value if isinstance(value, tuple | list) else ())]
    if isinstance(value, dict):
        candidates += [value.get("model_weights"), value.get("actor")]
    for state in candidates:
        if isinstance(state, dict):
            scripts = tuple(script for script in SCRIPTS if script.has_names_of(state))
            if scripts:
                return Known(state, scripts)
    return None


def choose_script(saved: Saved, known: Known) -> tuple[Script, str]:
    """Return the script and what decided for it. Raises SourceError where several fit or none does, UsageError."""
    scripts = _plausible(known)
    if saved.script is not None:
        return _find_script(saved.script, scripts), f"--script {saved.script}"
    why, near = _beside(saved.given.path, [s for s in scripts if s.activation])
    if len(near) == 1 and (why or near[0].is_told_by_names(known.state)):
        return near[0], why or "the names of its layers"
    raise _open_error(known.state, near or scripts)


def _plausible(known: Known) -> list[Script]:
    """Return the scripts whose last layer can have as many outputs. Raises SourceError where none has."""
    state = known.state
    for first in ("actor.weight", "actor.0.weight"):
        actor, critic = shape_of(state, first), shape_of(state, first.replace("actor", "critic"))
        if len(actor) == 2 == len(critic) and actor[1:] != critic[1:]:
            raise SourceError(
                "its actor and its critic are of no PPO",
                why="its critic reads other numbers than its actor: what bounds the actor's action is not in the file",
                fix=EXPORT_ONNX,
            )
    able = [s for s in known.scripts if width_of(state, s.head) not in range(1, s.least)]
    if not able:
        raise SourceError(
            f"its last layer, in {known.scripts[0].head}, gives one number",
            why="that is a value, as a critic gives it: there is nothing to choose from",
            fix="give the file with the actor's weights",
        )
    return able


def _find_script(key: str, scripts: Sequence[Script]) -> Script:
    for script in scripts:
        if script.key == key:
            return script
    keys = list(dict.fromkeys(s.key for s in scripts))
    known = {s.key for s in SCRIPTS}
    why = "its layers have other names" if key in known else "the scripts that have the names of its layers are known"
    raise UsageError(
        f"--script {key} does not fit the checkpoint" if key in known else f"--script {key}: unknown script",
        why=why,
        fix=f"{suggestion(key, keys)}one of: {', '.join(keys)}",
    )


def _beside(path: Path, scripts: Sequence[Script]) -> tuple[str, list[Script]]:
    """Return what the file's place says, and the scripts that are left."""
    for maker, file, folder, words in _PLACES:
        left = [s for s in scripts if s.maker == maker]
        if left and re.fullmatch(file, path.name) and re.fullmatch(folder, path.absolute().parent.name):
            return words, left
    return "", list(scripts)


def _open_error(state: Mapping[Any, Any], scripts: Sequence[Script]) -> SourceError:
    readings = "; ".join(
        f"{s.key}: {s.reading(state)}" + (f" ({s.maker}'s {s.evidence})" if s.evidence else "") for s in scripts
    )
    keys = list(dict.fromkeys(s.key for s in scripts))
    if len(keys) > 1:
        what = "it may be of any of these scripts"
    elif scripts[0].common:
        what = "its layers have names that networks of any kind have"
    else:
        what = "no known script has quite the names of its layers"
    return SourceError(
        f"{what}, and weights do not say what is computed with them",
        why=f"the readings are: {readings}" if len(keys) > 1 else f"the nearest is {readings}",
        fix=f"say which script saved it: --script {' or --script '.join(keys)}; of another script, {EXPORT_ONNX}",
    )
