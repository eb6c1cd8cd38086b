"""``python -m tests.peers.sweep``: our SavedModel of every policy of ../shared through the official converter.

Each is exported as a SavedModel alone, ``tensorflowjs_converter`` makes a web model of it, and TensorFlow.js runs that
on cpu and wasm beside TensorFlow on the SavedModel, as ``compare`` does. It prints a line for each that does not agree
in both, the counts by room, and ends with status 1 where there was one. Sources that are refused are counted apart.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify.options import VerifyOptions
from export_model.signatures.errors import ExportModelError
from tests.comparing import compare_artefacts
from tests.known import SHARED, SUFFIXES
from tests.peers.conftest import resident
from tests.peers.environment import ensure_peers

ROOMS = ("foreign", "genuine", "corpus", "corpus4")
RUNTIMES = ("tfjs-cpu", "tfjs-wasm")
#: Policies that one set of runtimes looks at: TensorFlow.js keeps a little of each.
_TURNS = 40


def sources(rooms: Sequence[str]) -> list[Path]:
    """The model files of rooms of ../shared; what is no policy is among them."""
    kinds = (*SUFFIXES, ".pth", ".zip", ".cleanrl_model")
    return [p for room in rooms for p in sorted((SHARED / room).rglob("*")) if p.suffix in kinds and p.is_file()]


def tried(source: Path, convert: Callable[[list[str]], None], pool: RuntimePool) -> Iterator[dict[str, object]]:
    """A record for each policy of a file: what failed, nothing where both runtimes agree; or why it is refused."""
    where = source.relative_to(SHARED).as_posix()
    with tempfile.TemporaryDirectory() as folder:
        try:
            made = list(export([source], ExportOptions(Path(folder), ("saved_model",), verify="none"), pool=pool))
        except ExportModelError as error:
            yield {"source": where, "refused": error.what}
            return
        for number, result in enumerate(made):
            ours, theirs = result.folder / "saved_model", Path(folder) / f"official{number}"
            wrong = []
            try:
                convert(["--input_format=tf_saved_model", str(ours), str(theirs)])
                options = VerifyOptions(samples=2, steps=3)
                report = compare_artefacts(
                    ours, [theirs], runtimes=("tensorflow", *RUNTIMES), options=options, pool=pool
                )
            except (AssertionError, ExportModelError) as error:
                wrong = [str(error)]
            else:
                missing = {*RUNTIMES} - {c.runtime for c in report.comparisons if c.passed}
                wrong = [*(failure_lines(report) if not report.passed else []), *sorted(missing)]
            yield {"source": where, "policy": result.policy.name, "wrong": wrong}


def main() -> int:
    """1 where one policy does not agree."""
    parser = argparse.ArgumentParser(prog="python -m tests.peers.sweep", description=__doc__.splitlines()[0])
    parser.add_argument("--rooms", default=",".join(ROOMS), help="folders of ../shared, by commas")
    parser.add_argument("--only", default="", help="only files whose path holds this")
    parser.add_argument("--log", type=Path, help="write a line of JSON for each policy")
    given = parser.parse_args()
    found = [s for s in sources(given.rooms.split(",")) if given.only in str(s)]
    counts: Counter[str] = Counter()
    with resident(ensure_peers(), "tensorflowjs.converters.converter", "pip_main") as convert:
        for start in range(0, len(found), _TURNS):
            with RuntimePool() as pool:
                for record in (r for s in found[start : start + _TURNS] for r in tried(s, convert, pool)):
                    kind = "refused" if "refused" in record else "wrong" if record["wrong"] else "right"
                    counts[f"{str(record['source']).split('/')[0]} {kind}"] += 1
                    counts[kind] += 1
                    if kind == "wrong":
                        print(json.dumps(record), flush=True)
                    if given.log is not None:
                        with given.log.open("a") as log:
                            log.write(json.dumps(record) + "\n")
    print(json.dumps(dict(sorted(counts.items())), indent=1))
    return 1 if counts["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
