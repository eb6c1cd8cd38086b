"""Every way to keep weights in every set and order of languages: the same files as alone, and they run."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import pytest
from msgspec.structs import replace

from export_model.converters.compiler.passes.weights import Storage, round_weights
from export_model.converters.formats.format import Format, WriteOptions
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.code import CodeOptions
from fixtures import FOLDER, path
from tests.programs.mains import MAINS, called
from tests.programs.test_options import build, said
from tests.programs.test_programs import PROGRAMS, need

pytestmark = pytest.mark.xdist_group("programs")

#: Dense, a camera, recurrent, discrete with masks, hybrid.
SOURCES = (
    *(path(name) for name in ("continuous", "visual", "recurrent", "discrete")),
    FOLDER / "torch_checkpoint" / "ppo_0_24_hybrid.onnx",
)
STORAGES: tuple[Storage, ...] = ("float32", "float16", "int8")
PLACES = ("source", "file")
#: Each begins with smaller sets in their order.
ORDERS = list(permutations(PROGRAMS))


def policies(storage: Storage) -> list[Policy]:
    """One of each kind, with weights that are rounded as they will be kept."""
    found = [read_source(each).policies()[0] for each in SOURCES]
    return [replace(p, graph=round_weights(p.graph, storage)) for p in found] if storage != "float32" else found


def how(storage: Storage, place: str) -> WriteOptions:
    return WriteOptions("{}", weights=storage, code=CodeOptions(math="own", weights=place))


def written(form: Format, policy: Policy, options: WriteOptions) -> dict[str, bytes]:
    return {name: pieces.to_bytes() for name, pieces in form.artifact(policy, options).files.items()}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("storage", STORAGES)
def test_no_language_changes_what_another_gets(storage: Storage, place: str) -> None:
    """All orders of all sets of languages; all that load a file load the same one."""
    for number, policy in enumerate(policies(storage)):
        alone = {form.key: written(form, policies(storage)[number], how(storage, place)) for form in PROGRAMS}
        for order in ORDERS:
            policy.graph.cache.clear()  # a new export
            for form in order:
                names = [each.key for each in order]
                assert written(form, policy, how(storage, place)) == alone[form.key], (policy.name, names, form.key)
        files = [{n: data for n, data in made.items() if n.endswith(".bin")} for made in alone.values()]
        assert all(each == files[0] and bool(each) == (place == "file") for each in files)


@pytest.mark.parametrize("storage", STORAGES)
def test_every_cell_runs(storage: Storage, tmp_path: Path) -> None:
    """As the same numbers in float32 in a header, to the bit; a self test knows the kernels' numbers."""
    rounded = policies(storage)
    printed, sizes = dict[tuple[str, str], list[str]](), dict[tuple[str, str], int]()
    cells = [(PROGRAMS[0], "float32", "source"), *((f, storage, place) for f in PROGRAMS for place in PLACES)]
    for form, kept, place in dict.fromkeys(cells):
        folder = tmp_path / f"{form.key}-{kept}-{place}"
        folder.mkdir()
        options = how(kept, place)  # type: ignore[arg-type]
        artifacts = [form.artifact(policy, options) for policy in rounded]
        for artifact in artifacts:
            artifact.write(folder)
        text = MAINS[form.key][0](*(called(policy, options.code) for policy in rounded))
        printed[folder.name, form.key] = said(build(form, text, folder), folder)
        sizes[kept, f"{form.key} {place}"] = sum(artifact.size for artifact in artifacts)
    expected, *found = printed.values()
    assert len(set(expected)) > 100
    assert not {"missed", "refused", "nan"} & set(expected)
    assert [who for who, each in zip(list(printed)[1:], found, strict=True) if each != expected] == []
    assert storage == "float32" or sizes[storage, "c source"] < sizes["float32", "c source"] * 0.8


@pytest.mark.parametrize("options", [{"weights": "int8"}, {"weights": "float16"}])
def test_the_export_of_the_documentation(options: dict[str, str], tmp_path: Path) -> None:
    """What ``--to c,csharp,js --quantize int8`` writes is run, and judged, in every language."""
    runtimes = tuple(need(form) for form in PROGRAMS)
    keys = tuple(form.key for form in PROGRAMS)
    (result,) = export([path("discrete")], ExportOptions(tmp_path, keys, verify=runtimes, **options))  # type: ignore[arg-type]
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
