"""Bundles to serve, exported once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import fixtures
from export_model.converters.runtimes.javascript.node import INSTALL_TFJS, js_home, package_version
from fixtures.trained import run_folder
from tests.commands import export_model

Bundle = Callable[[str], Path]


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """A fixture's bundle by name ("continuous", "3DBall", "Tennis-LeftBrain"); skips without the npm packages."""
    if package_version(js_home(), "@tensorflow/tfjs") is None:
        pytest.skip(f"the npm packages are not installed: {INSTALL_TFJS}")
    home = tmp_path_factory.mktemp("bundles")

    def of(name: str) -> Path:
        if not (home / name).is_dir():
            own = fixtures.path(name) if name.islower() else run_folder(name.partition("-")[0])
            ran = export_model(own, "-o", home, "--to", "bytes,tfjs", "--verify", "none")
            assert ran.status == 0, ran.err
        return home / name

    return of
