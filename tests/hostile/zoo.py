"""Model files that would do something else than be converted, each made in a folder of the test that runs it.

A case writes its files to ``folder``; where it gets what it wants, it writes the file ``marker`` (or reads what it must
not, or takes memory). It returns the source to give, and, where it is one, the bundle.
"""

from __future__ import annotations

from tests.hostile import zoo_bundles, zoo_graphs, zoo_large, zoo_onnx, zoo_saved_models
from tests.hostile.making import CASES, calling, frozen, function, onnx_policy, saved

#: Where the cases are; each is registered as its module is imported.
ROOMS = (zoo_graphs, zoo_saved_models, zoo_bundles, zoo_onnx, zoo_large)

__all__ = ["CASES", "ROOMS", "calling", "frozen", "function", "onnx_policy", "saved"]
