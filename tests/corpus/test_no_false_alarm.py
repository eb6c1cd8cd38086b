"""Nothing that is right is called wrong: a third of ../shared/genuine, each file with a seed of its own.

``python -m tests.corpus.false_alarms`` runs all of it in ten seeds.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from converters.runtimes.pool import RuntimePool
from signatures.errors import SourceError
from tests.corpus.false_alarms import GENUINE, alarms, genuine_files, verified

pytestmark = [pytest.mark.corpus, pytest.mark.slow]

#: ML-Agents' converter left an op out, so it computes something else than was trained, and is refused.
BROKEN = "0.10.1tf115-ppo-continuous/Brain.nn"
FILES = [
    pytest.param(file, 1 + number, id=f"{file.parent.name}-{file.name}")
    for number, file in enumerate(genuine_files())
    if number % 3 == 0
] or [pytest.param(Path("absent"), 0, id="shared-is-absent")]


@pytest.mark.parametrize(("file", "seed"), FILES)
def test_a_good_policy_raises_no_alarm(file: Path, seed: int, pool: RuntimePool) -> None:
    if "/".join(file.parts[-2:]) == BROKEN:
        with pytest.raises(SourceError):
            verified(file, seed, pool)
        return
    found = [line for report in verified(file, seed, pool) for line in alarms(report)]
    assert not found, "\n".join(found)


def test_the_genuine_files_are_whole() -> None:
    """87 frozen graphs, 44 .nn and 24 .onnx, so that nothing falls out of the measurement unseen."""
    if not GENUINE.is_dir():
        pytest.skip("../shared is not beside this checkout")
    assert len(genuine_files()) == 155
