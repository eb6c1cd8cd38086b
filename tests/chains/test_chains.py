"""Formats chained at random, source → a → b → c: the policy at the end is the one that a direct export gives.

The contract is the same to the letter but for the source's own names; the numbers are those of the direct export by the
numpy kernels, and in one runtime that computes by itself. A failing chain is repeated with ``--hypothesis-seed``.
"""

from __future__ import annotations

import itertools
import os
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from export_model.converters.runtimes.pool import RuntimePool
from tests.chains.hops import FORMS, Hop, assert_runs_alike, told, walk
from tests.chains.starts import GENUINE, OWN, Start
from tests.conftest import FULL

pytestmark = [pytest.mark.slow, pytest.mark.no_cover]

bounded = settings(
    max_examples=30 if FULL in os.environ else 12,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
HOPS = st.builds(
    Hop,
    form=st.sampled_from(FORMS),
    names=st.sampled_from(["canonical", "canonical", "source"]),
    opset=st.sampled_from([13, 15, 18, 21]),
    deterministic=st.sampled_from([False, False, False, True]),
)
CHAINS = st.lists(HOPS, min_size=2, max_size=4)


def check(start: Start, chain: list[Hop], pool: RuntimePool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for wanted, got in walk(start, chain, Path(folder)):
            assert told(got.policy) == told(wanted.policy)
            notes = got.policy.signature.notes
            assert len(set(notes)) == len(notes)
            assert_runs_alike(wanted, got, chain[-1].form, pool)


@bounded
@given(start=st.sampled_from(OWN), chain=CHAINS)
def test_a_chain_ends_in_the_policy_that_it_began_with(start: Start, chain: list[Hop], pool: RuntimePool) -> None:
    check(start, chain, pool)


@pytest.mark.corpus
@pytest.mark.skipif(not GENUINE, reason="../shared (public models, genuine graphs) is not beside this checkout")
@bounded
@given(start=st.sampled_from(GENUINE or OWN), chain=CHAINS)
def test_a_chain_from_a_genuine_file(start: Start, chain: list[Hop], pool: RuntimePool) -> None:
    check(start, chain, pool)


@pytest.mark.parametrize("start", OWN, ids=repr)
def test_every_policy_through_all_formats(start: Start, pool: RuntimePool) -> None:
    """Once round, in a fixed order: what chance may leave out of the tests above."""
    check(start, [Hop(form) for form in ("onnx", "tfjs", "saved_model", "bytes", "bundle")], pool)


@pytest.mark.parametrize(("first", "second"), list(itertools.product(FORMS, FORMS)))
def test_every_pair_of_formats(first: str, second: str, pool: RuntimePool) -> None:
    start = next(s for s in OWN if s.name == "recurrent")
    check(start, [Hop(first, names="source"), Hop(second, names="source")], pool)
