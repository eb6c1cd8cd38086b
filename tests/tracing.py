"""When coverage traces: while the product is imported, and in one case in so many of what runs the same lines.

Python takes nearly twice as long under it (3.11 has no other way than to be told of every line).
"""

from __future__ import annotations

import importlib
import pkgutil
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, Final

import pytest

import export_model

#: Where one file after the other runs the same lines, coverage traces one in so many.
TRACED: Final = {"corpus": 8, "legacy": 8, "slow": 4}
#: Of a test with more than so many cases, one in four.
MANY: Final = 64


class Tracing:
    """A plugin of pytest beside pytest-cov; without ``--cov`` it does nothing."""

    NAME: Final = "tracing"

    def __init__(self, config: pytest.Config) -> None:
        self._plugins = config.pluginmanager
        if hasattr(config, "workerinput") and (first := self._controller()) is not None:
            # A worker's command line has the -n of the main process, so pytest-cov 7.1 starts here what gathers
            # from workers, whose data is never written; and then, beside it, what traces. Where the second rested,
            # the first went on: what was told not to be traced was traced all the same.
            first.cov.stop()

    def _controller(self) -> Any:
        return self._plugins.getplugin("_cov").cov_controller if self._plugins.hasplugin("_cov") else None

    def mark(self, items: Sequence[pytest.Item]) -> None:
        """``no_cover`` for all but one in so many of each family."""
        if not self._plugins.hasplugin("_cov"):
            return
        families = Counter(item.nodeid.partition("[")[0] for item in items)
        swept: Counter[str] = Counter()
        for item in items:
            family = item.nodeid.partition("[")[0]
            of = max((count for name, count in TRACED.items() if item.get_closest_marker(name)), default=1)
            if swept[family] % max(of, 4 if families[family] > MANY else 1):
                item.add_marker(pytest.mark.no_cover)
            swept[family] += 1

    @pytest.hookimpl(wrapper=True)
    def pytest_collection(self, session: pytest.Session) -> Iterator[Any]:
        """All modules of the product are imported under coverage; then it rests until the first test.

        pytest rewrites and imports the tests meanwhile, which took most of a minute in each worker.
        """
        controller = self._controller()
        if controller is None or not controller.started or self._plugins.hasplugin("dsession"):  # whose workers collect
            return (yield)
        for module in pkgutil.walk_packages(export_model.__path__, "export_model."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)
        controller.pause()
        try:
            return (yield)
        finally:
            controller.resume()
