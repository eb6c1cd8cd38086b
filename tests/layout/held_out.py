"""``python -m tests.layout.held_out FOLDER``: what ``layout`` tells of public policies on which no bound was chosen.

``FOLDER/OWNER+NAME/repo`` are git directories of the repositories of ``held_back.py``; those that are missing are
counted as such. It prints a row for each policy and the figures of the acceptance; it has no limits that it could
fail by. A network that is there twice, as .onnx and .pt, or in two repositories, counts once.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.formats.source import ReadOptions
from export_model.converters.layouts.layouts import Layout, Mirrors, plausible_layouts
from export_model.converters.layouts.robots import ROBOTS
from export_model.exporter.export.sources import read_source
from export_model.exporter.layout.evidence import NEWEST, POSITIONS, SCALES, VELOCITIES, evidence_of
from export_model.exporter.layout.ranking import Ranking, best_change, chance_score, rank_layouts
from export_model.exporter.layout.telling import AGREES, DISAGREES, Told, judge_layout, tell_layout
from export_model.exporter.layout.trial import Trial
from export_model.signatures.errors import ExportModelError
from tests.layout.held_back import HELD_BACK, Case
from tests.layout.networks import Network, ShuffledTrial

#: Pairs of joints of one side that are exchanged in what is stated of a policy.
PAIRS = 2


def git(folder: Path, *arguments: str) -> bytes:
    return subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, check=True).stdout


def extract(case: Case, folder: Path, to: Path) -> Path:
    """A policy with what lies beside it in its repository. Raises CalledProcessError where it is missing."""
    repository = folder / case.repository.replace("/", "+") / "repo"
    place = Path(case.path).parent
    run = place.parent if place.name == "exported" else place
    beside = git(repository, "ls-tree", "-r", "--name-only", "HEAD", f"{run}/").decode().splitlines()
    wanted = [case.path, *(p for p in beside if p.endswith((".data", "deploy.yaml", "env.yaml")))]
    wanted += [case.order] if case.order.endswith(".yaml") else []
    for path in dict.fromkeys(wanted):
        (to / path).parent.mkdir(parents=True, exist_ok=True)
        (to / path).write_bytes(git(repository, "show", f"HEAD:{path}"))
    return to / case.path


def true_layouts(case: Case, trial: Trial, stated: Told) -> list[Layout]:
    """The layouts that a policy may truly have: one class, or none where no known term says it."""
    if case.order == "beside" or case.order.endswith(".yaml"):
        return [stated.stated.layout] if stated.stated is not None else []
    return [
        layout
        for layout in plausible_layouts(trial.width, trial.actions)
        if (layout.robot.key, layout.project, layout.frames) == (case.robot, case.project, case.frames)
        and layout.order.startswith(case.order)
        and (not case.stacked or layout.stacked == case.stacked)
    ]


def decided_among(trial: Trial, ranking: Ranking, fits: Callable[[Mirrors], bool]) -> bool:
    """Whether a class is decided where only some of those that were tried are known."""
    classes = tuple(c for c in ranking.classes if fits(c.mirrors))
    if not classes:
        return False
    left = Ranking(classes, chance_score(trial, classes[0].members[0]))
    if left.why_open:
        return False
    change, changed = best_change(trial, classes[0].members[0])
    return not replace(left, change=change, changed=changed).why_open


def exchanged(truth: Layout) -> Iterator[tuple[tuple[str, str], Layout]]:
    """The layout with two joints of one side in each other's place."""
    pairs = list(combinations(truth.robot.one_side, 2))
    for i in np.random.default_rng(0).permutation(len(pairs))[:PAIRS]:
        a, b = pairs[i]
        swap = {a: b, b: a}
        yield pairs[i], replace(truth, joints=tuple(swap.get(j, j) for j in truth.joints))


class Count:
    """What came of all policies."""

    def __init__(self) -> None:
        self.numbers: dict[str, int] = {}

    def add(self, name: str, holds: bool = True) -> None:
        self.numbers[name] = self.numbers.get(name, 0) + int(holds)


def measure(case: Case, path: Path, count: Count) -> str:
    """Tell one policy's layout, hold it against the truth, and return a row."""
    interface = str(path.parents[len(Path(case.path).parts) - 1] / case.order) if case.order.endswith(".yaml") else None
    (policy,) = read_source(path, ReadOptions(interface=interface)).policies(CompileOptions())
    trial = Trial(policy)
    stated = tell_layout(policy, ROBOTS)
    truth = true_layouts(case, trial, stated)
    ranking = stated.ranking
    if not truth or ranking.best is None:
        count.add("no known layout is the true one")
        count.add("of those decided", not ranking.why_open)
        return "no known layout is true; " + ("DECIDED" if not ranking.why_open else "open")
    true = truth[0].mirrors()
    first, decided = ranking.best.mirrors == true, not ranking.why_open
    count.add("policies")
    count.add("true class first", first)
    count.add("decided", decided)
    count.add("decided wrongly", decided and not first)
    count.add("decided without the true class", decided_among(trial, ranking, lambda m: m != true))
    count.add("decided of wrong robots and orders", decided_among(trial, ranking, lambda m: m[1] != true[1]))
    shuffled = rank_layouts(ShuffledTrial(policy), plausible_layouts(trial.width, trial.actions))
    count.add("decided of shuffled numbers", not shuffled.why_open)
    named = 0
    if decided and first:
        for pair, layout in exchanged(truth[0]):
            said = judge_layout(trial, ranking, [layout])
            hit = "exchanged" in said.says and all(joint in said.says for joint in pair)
            count.add("exchanged pairs")
            count.add("exchanged pairs called right", said.verdict == AGREES)
            count.add("exchanged pairs named", hit)
            count.add("exchanged pairs named, with status 1", hit and said.verdict == DISAGREES)
            named += hit
    closed = measure_evidence(truth[0], trial, count)
    return (
        f"{'first' if first else 'NOT FIRST'}, {'decided' if decided else 'open'} {ranking.best.score:.2f} "
        f"next {ranking.next:.2f}; {named} of {PAIRS if decided else 0} exchanges named; {closed}"
    )


def measure_evidence(truth: Layout, trial: Trial, count: Count) -> str:
    """What each rule of evidence says of the true order, and of one with positions and velocities exchanged."""
    swap = {POSITIONS: VELOCITIES, VELOCITIES: POSITIONS}
    found = [e for e in evidence_of(trial, truth) if e.term not in (NEWEST, SCALES)]
    other = [e for e in evidence_of(trial, wrongly_ordered(truth, swap)) if e.term == VELOCITIES]
    kind = "with a normaliser" if trial.mean is not None else "without a normaliser"
    count.add(f"{kind}: policies")
    count.add(f"{kind}: velocities told from positions", any(e.term == VELOCITIES and e.holds for e in found))
    count.add(f"{kind}: exchanged ones called right", any(e.holds for e in other))
    for e in found:
        count.add(f"{kind}: {e.term} by {e.says.split(' are')[0].split(' is')[0][:60]}, rightly", e.holds)
        count.add(f"{kind}: {e.term} wrongly", not e.holds)
    newest = next((e.says for e in evidence_of(trial, truth) if e.term == NEWEST), "")
    return "; ".join([*(f"{'' if e.holds else 'WRONGLY '}{e.term}" for e in found), newest[:15]])


def wrongly_ordered(truth: Layout, swap: Mapping[str, str]) -> Layout:
    return replace(truth, terms=tuple(swap.get(name, name) for name in truth.terms))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.layout.held_out", description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="policies whose path has this, and no random networks")
    parser.add_argument("--random", action="store_true", help="random networks alone")
    options = parser.parse_args(arguments)
    count = Count()
    with tempfile.TemporaryDirectory() as folder:
        for number, case in enumerate(HELD_BACK):
            if options.random or options.only not in f"{case.repository}/{case.path}":
                continue
            try:
                row = measure(case, extract(case, options.folder, Path(folder) / str(number)), count)
            except (subprocess.CalledProcessError, ExportModelError) as error:
                count.add("not measured")
                row = f"not measured: {str(error)[:120]}"
            print(f"{case.repository}/{case.path}: {row}", flush=True)
    drawn = (
        [Network(*size, seed) for seed, size in zip(range(200), SIZES * 40, strict=False)] if not options.only else []
    )
    for trial in drawn:
        count.add("random networks")
        ranking = rank_layouts(trial, plausible_layouts(trial.width, trial.actions))
        count.add("random networks decided", not ranking.why_open)
    for name, number in count.numbers.items():
        print(f"{name}: {number}")
    return 0


#: Widths and actions of random networks.
SIZES = [(45, 12), (47, 12), (96, 29), (41, 10), (48, 12), (57, 16)]

if __name__ == "__main__":
    sys.exit(main())
