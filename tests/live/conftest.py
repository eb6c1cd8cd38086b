"""What the training scripts of ``train`` exported, once per session and case."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.commands import python

Trained = Callable[[str], Path]


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """Case → the folder with what was exported (``out``) and what TensorFlow computed (``case.npz``)."""
    if importlib.util.find_spec("tensorflow") is None:
        pytest.skip("TensorFlow is not installed; get it with: pip install tensorflow-cpu")
    folders: dict[str, Path] = {}

    def folder_of(case: str) -> Path:
        if case not in folders:
            folder = tmp_path_factory.mktemp(case)
            ran = python("-m", "tests.live.train", case, folder)
            assert ran.status == 0, ran.err[-3000:]
            folders[case] = folder
        return folders[case]

    return folder_of
