"""C headers on other machines: they compute what the policy's kernels do, and are as small as they say."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.programs.members import header_of
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.sources import read_source
from fixtures import FIXTURES, path
from tests.programs.machines import MACHINES, Machine, flash_and_ram

ROOT = Path(__file__).resolve().parents[2]
SOURCES = {**{name: path(name) for name in FIXTURES}, "3DBall": ROOT / "fixtures/trained/3DBall"}
TESTED = """#define {upper}_IMPLEMENTATION
#define {upper}_SELFTEST
#include "{file}"
#include <stdio.h>
static {p}_memory memory;
int main(void)
{{
    printf("%d\\n", (int){p}_selftest(&memory));
    return 0;
}}
"""
LINKED = """#define {upper}_IMPLEMENTATION
#include "{file}"
static {p}_memory memory;
static {p}_input input;
static {p}_output output;
int main(void) {{ return (int){p}_act(&input, &memory, &output); }}
"""


def written(policy: Policy, program: str, folder: Path) -> str:
    """Write a policy's header, and return a program around it."""
    folder.mkdir(exist_ok=True)
    artifact, header = WRITTEN["c"].artifact(policy, WriteOptions("{}")), header_of(policy.name, policy.signature)
    artifact.write(folder)
    return program.format(p=header.prefix, upper=header.prefix.upper(), file=artifact.main)


@pytest.mark.slow
@pytest.mark.parametrize("machine", MACHINES, ids=lambda machine: machine.name)
@pytest.mark.parametrize("name", SOURCES)
def test_no_golden_number_is_missed(name: str, machine: Machine, tmp_path: Path) -> None:
    """The numbers are those of the kernels that TensorFlow's fixtures are held to; the compiler warns of nothing."""
    if reason := machine.missing():
        pytest.skip(reason)
    for i, policy in enumerate(read_source(SOURCES[name]).policies()):
        folder = tmp_path / str(i)
        text = written(policy, TESTED, folder)
        (folder / "main.c").write_text(text)
        done = subprocess.run(machine.build(folder), check=True, capture_output=True, text=True, timeout=120)
        assert done.stdout.split() == ["0"]


@pytest.mark.slow
def test_a_trained_policy_fits_a_microcontroller(tmp_path: Path) -> None:
    """Bytes of 3DBall with draws, weights, mathematics and one agent: 22 kB of flash, 4 kB of RAM at most."""
    if reason := MACHINES[1].missing():
        pytest.skip(reason)
    (policy,) = read_source(SOURCES["3DBall"]).policies()
    flash, ram = flash_and_ram(tmp_path, written(policy, LINKED, tmp_path))
    assert 4 * 1000 < flash <= 22_000
    assert 0 < ram <= 4_000
