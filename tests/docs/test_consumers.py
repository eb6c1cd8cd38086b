"""docs/support-tables.md has what ``python -m tests.consumers`` writes, and the program prints the same tables."""

from __future__ import annotations

import json

from export_model.converters.consumers.published import consumer_tables
from export_model.converters.consumers.unity.importers import IMPORTERS
from tests import consumers
from tests.commands import export_model, is_refused
from tests.support_tables import section


def test_the_page_is_that_of_the_tables() -> None:
    assert section(consumers.TITLE) == consumers.page()


def test_the_program_prints_the_tables() -> None:
    assert json.loads(export_model("consumers", "--json").out) == json.loads(json.dumps(consumer_tables()))


def test_each_importer_has_its_own_list() -> None:
    lists = {name: export_model("consumers", name).out for name in IMPORTERS}
    assert "Erf_01" in lists["Barracuda 2.0.0"] and "Erf_01" not in lists["Barracuda 2.3.1"]
    assert all(name in export_model("consumers").out for name in IMPORTERS)
    is_refused(export_model("consumers", "Barracuda 9"), "Inference Engine 2.4.0")


def test_whatever_is_thrown_has_its_words_and_whatever_is_not_has_none() -> None:
    for reading in consumer_tables()["readings"]:
        thrown = reading["reading"] in ("refused", "fails")
        recorded = not reading["evidence"].startswith(("beside the 352", "cases/", "r4, "))
        assert bool(reading["exception"]) == (thrown and recorded), reading
