"""Environments with Gymnasium's interface: its own by id, and the user's own code. One environment for each episode.

What is asked of an environment: ``reset(seed=)`` → (observation, info), ``step(action)`` → (observation, reward,
terminated, truncated, info), ``action_space``; Gymnasium need not be installed for code that has these. Masks are taken
where they usually are: ``info["action_mask"]``, the observation's ``action_mask``, or the method ``action_masks()``.
"""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from export_model.exporter.play.worlds import MakeWorld, StepOutcome, WorldView
from export_model.signatures.errors import UsageError, suggestion
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature, TensorSpec

Array = np.ndarray
_MASKS = ("action_mask", "action_masks")
_SUCCESS = ("is_success", "success")


class GymnasiumWorld:
    """Environments side by side; each row is one that is reset from a seed of its own."""

    def __init__(
        self, name: str, make: Callable[[], Any], signature: PolicySignature, notes: tuple[str, ...] = ()
    ) -> None:
        self.name, self.notes = name, notes
        self._make, self._signature = make, signature
        self._environments = [self._make_environment()]
        self._masked = any(s.role is Role.MASKS for s in signature.inputs)
        self._space = getattr(self._environments[0], "action_space", None)
        self._check_actions()
        seen, info = self._reset(self._environments[0], 0)
        _observations_of(signature, [seen], self.name)
        if self._masked and self._masks_of(self._environments[0], seen, info) is None:
            raise UsageError(
                f"--env {name}: the policy takes masks, and the environment gives none",
                fix='give them as info["action_mask"], 1 for what is allowed',
            )

    def begin(self, episodes: int, seed: int) -> WorldView:
        """Reset an environment for each episode."""
        while len(self._environments) < episodes:
            self._environments.append(self._make_environment())
        seeds = np.random.SeedSequence(seed).generate_state(episodes) >> np.uint32(1)
        rows = [self._reset(env, int(s)) for env, s in zip(self._environments[:episodes], seeds, strict=True)]
        self._ended = np.zeros(episodes, bool)
        self._seen = [seen for seen, _ in rows]
        self._infos = [info for _, info in rows]
        self._masks = [self._masks_of(self._environments[r], *rows[r]) for r in range(episodes)] if self._masked else []
        return self._view()

    def step(self, continuous: Array | None, discrete: Array | None) -> StepOutcome:
        """Step every environment whose episode goes on."""
        count = len(self._seen)
        rewards, ended, success = np.zeros(count), self._ended.copy(), np.zeros(count, bool)
        rows = np.flatnonzero(~self._ended).tolist()
        actions = self._actions(continuous, discrete)
        with _own_code(self.name, "step"):
            for row in rows:
                seen, reward, terminated, truncated, info = self._environments[row].step(actions[row])
                self._seen[row], self._infos[row] = seen, info
                rewards[row], ended[row] = float(reward), bool(terminated or truncated)
                success[row] = bool(info) and any(bool(info.get(key, False)) for key in _SUCCESS)
        for row in rows if self._masked else ():
            self._masks[row] = self._masks_of(self._environments[row], self._seen[row], self._infos[row])
        self._ended = ended
        return StepOutcome(self._view(), rewards, ended, success)

    def _make_environment(self) -> Any:
        with _own_code(self.name, "making it"):
            return self._make()

    def _reset(self, env: Any, seed: int) -> tuple[Any, Mapping[str, Any]]:
        with _own_code(self.name, "reset"):
            seen, info = env.reset(seed=seed)
        return seen, info

    def _view(self) -> WorldView:
        masks = [m for m in self._masks if m is not None]
        stacked = _observations_of(self._signature, self._seen, self.name)
        return WorldView(stacked, np.stack(masks).astype(np.float32) if masks else None)

    def _masks_of(self, env: Any, seen: Any, info: Mapping[str, Any]) -> Array | None:
        for place in (info, seen):
            found = next((place[k] for k in _MASKS if k in place), None) if isinstance(place, Mapping) else None
            if found is not None:
                break
        else:
            method = getattr(getattr(env, "unwrapped", env), "action_masks", None)
            if method is None:
                return None
            with _own_code(self.name, "action_masks"):
                found = method()
        parts = found if isinstance(found, tuple | list) and np.ndim(found[0]) else [found]
        return np.concatenate([np.asarray(part, np.float32).reshape(-1) for part in parts])

    # ---- actions

    def _check_actions(self) -> None:
        """Raise UsageError where the policy's actions are not the environment's."""
        sizes, box = _choices(self._space), getattr(self._space, "shape", None)
        signature = self._signature
        width = next((s.shape[-1] for s in (h.spec for h in signature.heads) if s.is_continuous), None)
        if sizes is not None:
            fits = signature.action_space == "discrete" and signature.branches == sizes
        else:
            count = None if box is None else int(np.prod(box))
            fits = signature.action_space == "continuous" and width in (None, count)
        if not fits:
            does = f"branches {list(signature.branches)}" if signature.branches else f"{width} continuous actions"
            raise UsageError(
                f"--env {self.name}: the policy does not fit the environment",
                why=f"the environment takes {self._space}; the policy gives {does}",
                fix="choose an environment that the policy was trained in",
            )

    def _actions(self, continuous: Array | None, discrete: Array | None) -> list[Any]:
        """Return actions as the environment takes them: a number, a list of choices, or a box within its bounds."""
        space: Any = self._space
        if continuous is None:
            assert discrete is not None
            if not hasattr(space, "nvec"):
                return [int(choice) for choice in discrete[:, 0] + int(getattr(space, "start", 0))]
            return list(np.asarray(discrete, np.int64))
        low, high = getattr(space, "low", -np.inf), getattr(space, "high", np.inf)
        boxes = continuous.reshape(len(continuous), *space.shape)
        return list(np.clip(boxes, low, high).astype(getattr(space, "dtype", np.float32)))


def _choices(space: Any) -> tuple[int, ...] | None:
    """Return the branches of a space of choices; None where it is none."""
    if hasattr(space, "nvec"):
        return tuple(int(n) for n in np.asarray(space.nvec).reshape(-1))
    return (int(space.n),) if hasattr(space, "n") else None


def _observations_of(signature: PolicySignature, seen: Sequence[Any], name: str) -> dict[str, Array]:
    """Return what all agents see by the policy's names. Raises UsageError where it does not fit."""
    specs, first = signature.observations, seen[0]
    try:
        if isinstance(first, Mapping):
            given = {key: np.asarray([row[key] for row in seen]) for key in first if key not in _MASKS}
        else:
            given = {specs[0].name if len(specs) == 1 else "the observation": np.asarray(seen)}
    except (KeyError, ValueError) as error:
        raise UsageError(
            f"--env {name}: episodes differ in what they observe",
            why=f"{type(error).__name__}: {error}",
            fix="give the same observations in the same shapes at every step",
        ) from error
    found = {}
    for spec in specs:
        only = next(iter(given)) if len(given) == len(specs) == 1 else ""
        key = spec.name if spec.name in given else only
        array = None if key not in given else _fit_shape(spec, given[key])
        if array is None:
            shapes = ", ".join(f"{k} {list(v.shape[1:])}" for k, v in given.items())
            raise UsageError(
                f"--env {name}: the policy does not fit the environment",
                why=f"the policy observes {spec.name!r} {spec.shape_text}; the environment gives {shapes}",
                fix="give observations by the policy's names and in its shapes",
            )
        found[spec.name] = array
    return found


def _fit_shape(spec: TensorSpec, array: Array) -> Array | None:
    """Return observations [agents, ...] in the policy's shape: as they are, flat, or a number as a vector with a 1."""
    wanted, given = spec.shape[1:], array.shape[1:]
    if len(wanted) == len(given) and all(n in (None, m) for n, m in zip(wanted, given, strict=True)):
        return array
    if len(wanted) == 1 and math.prod(given) == wanted[0]:
        return array.reshape(len(array), -1)
    if len(wanted) == 1 and not given and array.dtype.kind in "iu" and wanted[0] is not None:
        fits = bool(((array >= 0) & (array < wanted[0])).all())
        return np.eye(wanted[0], dtype=np.float32)[array] if fits else None
    return None


# ------------------------------------------------------------------ by name


def gymnasium_maker(env: str, known: Sequence[str]) -> MakeWorld:
    """Return what makes worlds of a Gymnasium id. Raises UsageError where Gymnasium is not installed, or has none."""
    ours = f"one of {', '.join(known)}"
    try:
        gymnasium: Any = importlib.import_module("gymnasium")
    except ModuleNotFoundError as error:
        raise UsageError(
            f"--env {env}: unknown environment",
            why="Gymnasium, which may have one of that name, is not installed",
            fix=f"{suggestion(env, known)}{ours}; a Gymnasium id after pip install 'export-model[gym]'; or module:make",
        ) from error
    if env not in gymnasium.registry:
        raise UsageError(
            f"--env {env}: unknown environment",
            why="Gymnasium has none of that name either",
            fix=f"{suggestion(env, [*known, *gymnasium.registry])}{ours}, a Gymnasium id, or module:make",
        )
    # Its checker looks at every step of every episode, which takes a third of the time.
    return lambda signature: GymnasiumWorld(env, lambda: gymnasium.make(env, disable_env_checker=True), signature)


def own_maker(env: str) -> MakeWorld:
    """Return what makes worlds of ``module:make``: code of the user's own, of the current folder where nobody has it.

    The folder comes last: a file in it takes no other module's place.
    """
    module, _, function = env.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    with _own_code(env, "importing it"):
        found = getattr(importlib.import_module(module), function, None)
    if not callable(found):
        raise UsageError(
            f"--env {env}: {module} has no function {function!r}", fix="name one that makes an environment"
        )
    note = f"the environment {env} is your own code; it ran in this process"
    return lambda signature: GymnasiumWorld(env, found, signature, (note,))


@contextmanager
def _own_code(name: str, doing: str) -> Iterator[None]:
    """Errors of an environment's code are about that. Raises UsageError."""
    try:
        yield
    except UsageError:
        raise
    except Exception as error:
        raise UsageError(
            f"--env {name}: {doing} failed",
            why=f"{type(error).__name__}: {error}",
            fix="look at the environment's own code",
        ) from error
