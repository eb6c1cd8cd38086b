"""What two files state of one policy's numbers: another joint, scale, sign or pose is a failure that names it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.verify.report import ParityReport
from tests.comparing import compare_artefacts
from tests.interfaces.made import MJLAB, write_onnx

TASK = MJLAB["Mjlab-Velocity-Flat-Unitree-G1"]
#: Keys of the metadata that have a number or a name for each joint.
LISTS = ("joint_names", "action_scale", "default_joint_pos", "joint_stiffness", "joint_damping")


def policy(folder: Path, metadata: dict[str, str]) -> Path:
    return write_onnx(folder / "policy.onnx", TASK["observations"], TASK["actions"], metadata)


def stated(report: ParityReport) -> list[str]:
    return [f.reason for f in report.failures if f.kind == "interface"]


def exchange(values: list[str]) -> list[str]:
    other = next(i for i in range(1, len(values)) if values[i] != values[0])
    values[0], values[other] = values[other], values[0]
    return values


def number(change: Callable[[float], float], place: int) -> Callable[[list[str]], list[str]]:
    def edit(values: list[str]) -> list[str]:
        place_of = next(i for i in range(place, len(values)) if abs(float(values[i])) > 0.01)
        values[place_of] = f"{change(float(values[place_of])):.3f}"
        return values

    return edit


PLANTED = {
    "names exchanged": ("joint_names", exchange),
    **{
        f"{key} {name} at {place}": (key, number(change, place))
        for key in LISTS[1:]
        for name, change in {"doubled": lambda x: 2 * x, "of another sign": lambda x: -x}.items()
        for place in (0, 3)
    },
    "scale moved": ("action_scale", number(lambda x: x + 0.1, 5)),
    "pose moved": ("default_joint_pos", number(lambda x: x + 0.1, 5)),
    "scales exchanged": ("action_scale", exchange),
}


def test_twenty_planted_differences_are_named(tmp_path: Path, pool: RuntimePool) -> None:
    metadata = TASK["metadata"]
    reference = policy(tmp_path / "reference", metadata)
    assert len(PLANTED) == 20
    candidates = []
    for place, (key, edit) in enumerate(PLANTED.values()):
        changed = {**metadata, key: ",".join(edit(metadata[key].split(",")))}
        candidates.append(policy(tmp_path / f"{place}", changed))
    report = compare_artefacts(reference, candidates, runtimes="onnxruntime", pool=pool)
    assert report.passed is False
    assert len({f.format for f in report.failures}) == 20
    assert {f.kind for f in report.failures} == {"interface"}
    assert "the interface differs: " in report.sentence


def test_one_interface_is_no_difference_and_one_side_alone_neither(tmp_path: Path, pool: RuntimePool) -> None:
    whole, bare = policy(tmp_path / "whole", TASK["metadata"]), policy(tmp_path / "bare", {})
    for reference, candidate in ((whole, whole), (whole, bare), (bare, whole)):
        report = compare_artefacts(reference, candidate, runtimes="onnxruntime", pool=pool)
        assert report.passed is True
        assert stated(report) == []
        assert any("alone states an interface" in note for note in report.notes) is (reference != candidate)


@pytest.mark.parametrize("wrong", [False, True])
def test_a_bundle_is_held_to_what_the_reference_states(tmp_path: Path, pool: RuntimePool, wrong: bool) -> None:
    metadata = dict(TASK["metadata"])
    reference = policy(tmp_path / "reference", metadata)
    if wrong:
        metadata["action_scale"] = ",".join(number(lambda x: 2 * x, 0)(metadata["action_scale"].split(",")))
    (result,) = export([policy(tmp_path / "other", metadata)], ExportOptions(tmp_path / "out", verify="none"))
    report = compare_artefacts(reference, result.folder, runtimes="onnxruntime", pool=pool)
    assert bool(stated(report)) is wrong
    assert report.passed is not wrong
    assert not wrong or "scale[0] of " in stated(report)[0]
