"""Saved models of Stable-Baselines3, sb3-contrib and SBX (``.zip``), and their unpacked folders."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from export_model.converters.formats.stable_baselines3 import run_folder as _run_folder
    from export_model.converters.formats.stable_baselines3 import source as _source
else:
    _run_folder, _source = defer_imports(__name__, "run_folder", "source")

#: What model.save writes beside ``data``; SBX has no policy.pth.
_WRITTEN = {"policy.pth", "_stable_baselines3_version"}

FORMATS = (
    Format(
        key="stable_baselines3",
        label="a saved model of Stable-Baselines3 (.zip)",
        sniff=lambda file: "data" in file.entries and bool(_WRITTEN & set(file.entries)),
        marker="policy.pth",
        read=_source.read,
        takes=frozenset({"activation", "normaliser"}),
        library="stable_baselines3",
    ),
    Format(
        key="stable_baselines3_run",
        label="a run's folder of Stable-Baselines3's zoo",
        at=_run_folder.is_run,
        members=_run_folder.members,
        takes=frozenset({"step", "activation", "normaliser"}),
        library="stable_baselines3",
    ),
)
