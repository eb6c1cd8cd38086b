"""The sample of ``python -m tests.faults``: policies of every family, with faults of every class, none missed."""

from __future__ import annotations

import pytest

from export_model.converters.runtimes.pool import RuntimePool
from tests.faults.__main__ import SAMPLED, Turns, outcomes, sample
from tests.faults.families import Member, members

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("runtimes"), pytest.mark.usefixtures("runtimes")]

FAMILIES: dict[str, list[Member]] = {}
for member in sample(members()):
    FAMILIES.setdefault(member.family, []).append(member)
#: One for all families: each plants what the others planted least.
TURNS = Turns()


@pytest.mark.parametrize("family", FAMILIES)
def test_no_fault_is_missed(family: str, processes: RuntimePool) -> None:
    found = list(outcomes(FAMILIES[family], processes, count=SAMPLED, turns=TURNS))
    assert any(o.verdict == "caught" for o in found)
    assert not [str(o) for o in found if o.verdict == "missed"]
