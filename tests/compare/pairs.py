"""Right pairs of files, compared as a user would: ``python -m tests.compare.pairs [--torch PYTHON] [--only KIND]``.

Kinds: ``genuine`` (what one training of ML-Agents wrote), ``trained`` (a checkpoint beside its trainer's own ONNX),
``modules`` (modules.py, run by a Python with torch and onnxscript), ``targets`` (fixtures and what we write of them),
and only when named ``selves`` (each file of ../shared beside itself). ``--part 2/5`` compares a fifth of the pairs.
Every pair must agree with no option, or with the one that an error asks for. No test runs it: it takes minutes.
"""

from __future__ import annotations

import argparse
import itertools
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.formats.bundle.bundle import Bundle
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.formats.source import ReadOptions
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.compare.comparison import CompareOptions, compare_artefacts
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.verify.options import VerifyOptions
from export_model.signatures.errors import ExportModelError
from export_model.signatures.roles import Role

ROOT = Path(__file__).resolve().parents[2]
FIXTURES, SHARED = ROOT / "fixtures", ROOT.parent / "shared"
TARGETS = ("bytes", "saved_model", "tfjs", "onnx", "nn", "litert", "c", "js")
#: Of these the trainer's own ONNX lost the output of the memory (ML-Agents 0.20 to 0.22): no right pair.
LOST_MEMORY = {"ppo_0_21_discrete_lstm", "ppo_0_22_lstm"}
#: ML-Agents' converter lost operands of an op in the Barracuda file of this run: a wrong pair, and refused.
LOST_OPERANDS = "0.10.1tf115-ppo-continuous"
#: How the names of files end that are compared with themselves.
KINDS = {".bytes", ".pb", ".nn", ".onnx", ".pt", ".pth", ".zip", ".keras", ".h5", ".tflite", ".cleanrl_model"}
RUNTIMES = ("tensorflow", "onnxruntime", "tfjs-cpu", "litert", "c", "node")


class Pair(Struct, frozen=True):
    """Two files of one policy; ``foreign``: none of them is ours."""

    kind: str
    reference: Path
    candidate: Path
    foreign: bool = True

    def __str__(self) -> str:
        places = (p.parent.name + "/" + p.name for p in (self.reference, self.candidate))
        return f"{self.kind} {' = '.join(places)}"


def genuine() -> Iterator[Pair]:
    """Frozen graph, ONNX, Barracuda file and run folder of one training.

    A Barracuda file has no seeds: beside it, an ONNX whose samplers have one would be told so, and fail.
    """
    for case in sorted(p for p in (SHARED / "genuine").glob("*") if p.is_dir()):
        frozen = next((p for p in sorted(case.iterdir()) if p.suffix == ".bytes" or p.name.startswith("frozen")), None)
        files = [
            frozen,
            *sorted(case.glob("*.onnx")),
            *(sorted(case.glob("*.nn")) if case.name != LOST_OPERANDS else ()),
        ]
        files += [case / "checkpoint"] if (case / "checkpoint").is_file() else []
        yield from (Pair("genuine", *two) for two in itertools.combinations(filter(None, files), 2))


def trained() -> Iterator[Pair]:
    """A checkpoint and the ONNX that its trainer wrote beside it."""
    for folder in (FIXTURES / "torch_checkpoint", SHARED / "foreign"):
        for file in sorted(folder.glob("*.pt")):
            if file.with_suffix(".onnx").exists() and file.stem not in LOST_MEMORY:
                yield Pair("trained", file, file.with_suffix(".onnx"))
                yield Pair("trained", file.with_suffix(".onnx"), file)


def modules(folder: Path, python: str) -> Iterator[Pair]:
    """The forms that PyTorch and its exporters write of one module."""
    subprocess.run([python, str(Path(__file__).with_name("modules.py")), str(folder)], check=True, capture_output=True)
    for place in sorted(folder.iterdir()):
        files = sorted(p for p in place.iterdir() if p.suffix in (".pt", ".onnx"))
        yield from (Pair("modules", *two) for two in itertools.combinations(files, 2))


def targets(folder: Path) -> Iterator[Pair]:
    """Fixtures and what export-model writes of them."""
    sources = [FIXTURES / f"{name}.bytes" for name in ("continuous", "discrete", "recurrent", "visual", "sampled")]
    names = ("ppo_1_1", "ppo_1_1_discrete", "ppo_1_1_hybrid_lstm", "sac_1_1", "poca_0_26_discrete", "ppo_0_24_hybrid")
    sources += [FIXTURES / f"torch_checkpoint/{name}.pt" for name in names]
    sources += [FIXTURES / f"torchscript/{name}.pt" for name in ("isaac_gru_script", "legged_lstm_trace", "mlp_trace")]
    sources += [FIXTURES / "sb3_zip/ppo_box.zip", FIXTURES / "sb3_zip/sac_box.zip", FIXTURES / "sb3/torch_actor.onnx"]
    for source in sources:
        for target in TARGETS:
            place = folder / source.stem / target
            try:
                (result,) = export([source], ExportOptions(place, (target,), verify="none"))
            except ExportModelError:
                continue  # a target that this policy cannot have
            file = Bundle.open(result.folder).path(WRITTEN[target])
            yield Pair("targets", source, file, foreign=False)


def selves() -> Iterator[Pair]:
    """Every file of ../shared that export reads, beside itself."""
    files = (p for p in sorted(SHARED.rglob("*")) if p.suffix in KINDS or p.name in ("checkpoint", "saved_model.pb"))
    for file in files:
        try:
            policies = read_source(file).policies()
        except ExportModelError:
            continue
        if policies:
            yield Pair("selves", file, file)


def agrees(pair: Pair, pool: RuntimePool) -> tuple[bool, str]:
    """(whether the pair agrees, what was said, or the option that an error asked for)."""
    options = CompareOptions(judging=VerifyOptions(runtimes=RUNTIMES), allow_unverified=True)
    needed = ""
    while True:
        try:
            report = compare_artefacts(pair.reference, pair.candidate, options, pool=pool)
        except ExportModelError as error:
            answer = None if needed else _option(error, pair)
            if answer is None:
                return False, str(error)
            needed, changed = answer
            options = replace(options, **changed)
            continue
        failed = [f"{f.output}: {f.to_dict().get('reason') or f.max_abs_diff}" for f in report.failures]
        return report.passed is not False and bool(report.comparisons), needed or "; ".join(failed)


def _option(error: ExportModelError, pair: Pair) -> tuple[str, dict[str, Any]] | None:
    """The option that an error asks for, with the value that its reader would give."""
    asked = re.search(r"--(candidate-)?(brain|sensors)", error.fix or "")
    if asked is None:
        return None
    if asked[2] == "brain":
        brain = CompileOptions(brain=(error.why or "").split(", ")[0])
        return f"--brain {brain.brain}", {"understanding": brain, "candidate_understanding": brain}
    (policy,) = read_source(pair.reference if asked[1] else pair.candidate).policies()  # which says what it observes
    roles = (Role.VECTOR, Role.VISUAL, Role.ENTITIES)
    sensors = tuple(tuple(n or 1 for n in s.shape[1:]) for s in policy.signature.inputs if s.role in roles)
    side = "candidate_read" if asked[1] else "read"
    return f"{asked[0]} {sensors}", {side: ReadOptions(sensors=sensors)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--torch", metavar="PYTHON", help="a Python with torch and onnxscript, for the modules")
    parser.add_argument("--only", metavar="KIND", choices=("genuine", "trained", "modules", "targets", "selves"))
    parser.add_argument("--part", metavar="N/OF", default="1/1", help="every so many pairs, from the Nth on")
    told = parser.parse_args()
    first, step = map(int, told.part.split("/"))
    counted: Counter[tuple[str, bool]] = Counter()
    foreign = 0
    with RuntimePool() as pool, tempfile.TemporaryDirectory() as folder:
        kinds = {"genuine": genuine, "trained": trained, "targets": lambda: targets(Path(folder) / "ours")}
        if told.only == "selves":
            kinds["selves"] = selves
        if told.torch is not None:
            kinds["modules"] = lambda: modules(Path(folder) / "modules", told.torch)
        for kind, pairs in kinds.items():
            for pair in itertools.islice(pairs() if told.only in (None, kind) else (), first - 1, None, step):
                right, said = agrees(pair, pool)
                counted[kind, right] += 1
                foreign += right and pair.foreign and pair.reference != pair.candidate
                if said or not right:
                    print(f"{'agrees' if right else 'FAILS'} {pair}: {said}", flush=True)
    for kind, right in sorted(counted):
        print(f"{kind}: {counted[kind, right]} {'agree' if right else 'FAIL'}")
    wrong = sum(n for (_, right), n in counted.items() if not right)
    print(f"{counted.total() - wrong} of {counted.total()} right pairs agree, of {foreign} neither file is ours")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
