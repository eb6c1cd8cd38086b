"""An old TensorFlow in its own process: ``python -m export_model.converters.runtimes.tensorflow1.child NAME LIBRARY``.

NAME is the runtime's, LIBRARY the path of the shared object that has the C API. An assertion within TensorFlow ends
this process, not its parent.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from export_model.converters.files.children.child import claim_stdout, serve
from export_model.converters.runtimes.tensorflow1.library import (
    LegacyError,
    LegacySession,
    library_version,
    load_library,
)


def main() -> None:
    """Entry of the child process."""
    out = claim_stdout()
    name, path = sys.argv[1:]
    library = load_library(path)

    def load(header: Mapping[str, Any]) -> LegacySession:
        return LegacySession(Path(header["path"]).read_bytes(), library)

    serve(name, library_version(library), load, (LegacyError,), out)


if __name__ == "__main__":
    main()
