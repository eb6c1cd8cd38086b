"""Makes ``official/``: what tensorflowjs_converter 4.22 writes of the models of ``tests.saved_model.make_models``.

``python -m tests.tfjs_reader.make_official`` (needs the peers' environment, see ``tests.peers.environment``). The
results are committed: the converter is 1.8 GB, and no test should need it.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.peers.environment import ensure_peers

FOLDER = Path(__file__).with_name("official")
#: Name → (SavedModel, its arrays, further flags of the converter).
MODELS = {
    "function": ("function", "function", ()),
    "keys": ("keys", "keys", ()),
    "keras": ("exported", "keras", ()),
    "keras-uint8": ("exported", "keras", ("--quantize_uint8", "*")),
    "keras-uint16": ("exported", "keras", ("--quantize_uint16", "*")),
    "keras-float16": ("exported", "keras", ("--quantize_float16", "*")),
}


def main() -> None:
    peers = ensure_peers()
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir()
    with tempfile.TemporaryDirectory() as scratch:
        subprocess.run([sys.executable, "-m", "tests.saved_model.make_models", scratch], check=True)
        for name, (model, arrays, flags) in MODELS.items():
            source = Path(scratch) / model
            peers.run(
                [
                    *peers.tensorflowjs_converter(),
                    *("--input_format", "tf_saved_model", "--output_format", "tfjs_graph_model"),
                    *("--signature_name", "serving_default", "--saved_model_tags", "serve"),
                    *flags,
                    str(source),
                    str(FOLDER / name),
                ]
            )
            shutil.copyfile(Path(scratch) / f"{arrays}.npz", FOLDER / f"{arrays}.npz")


if __name__ == "__main__":
    main()
