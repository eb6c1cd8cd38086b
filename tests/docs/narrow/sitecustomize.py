"""On PYTHONPATH, what ``auto`` stands for is onnxruntime (with numpy): most pages are not about the runtimes.

Python imports this module by its name before the program. A runtime's child (``-c``) does not need it.
"""

import sys

if "-c" not in sys.orig_argv:
    from export_model.converters.runtimes import pool

    pool._ON_REQUEST = frozenset(r.name for r in pool.RUNTIMES if r.name not in ("numpy", "onnxruntime"))
