"""TensorFlow 1.4 and 1.7 for tests: fetched by the product's own installation on first use."""

from __future__ import annotations

import pytest

from export_model.converters.runtimes.tensorflow.install import install
from export_model.converters.runtimes.tensorflow.release import RELEASES, Release
from export_model.signatures.errors import RuntimeUnavailableError

#: A parameter per version, in a group of its own: with several test processes each is started in one of them only.
VERSIONS = [pytest.param(r, id=r.runtime, marks=pytest.mark.xdist_group(r.runtime)) for r in RELEASES]


def ensure(release: Release) -> str:
    """The name of the runtime, which is installed then; the test is skipped where it cannot be."""
    try:
        install(release, print)
    except RuntimeUnavailableError as error:
        pytest.skip(f"{error.what}: {error.why}")
    return release.runtime
