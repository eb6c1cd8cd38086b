"""What the training scripts of ``train`` exported, once per session, by one process."""

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
    folder = tmp_path_factory.mktemp("trained")
    ran = python("-m", "tests.live.train", folder)
    assert ran.status == 0, ran.err[-3000:]
    return lambda case: folder / case
