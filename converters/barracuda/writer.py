"""``.nn``: a policy for Unity's Barracuda, in the version that all of them load.

The contract lies behind the weights, as version 18 of the format keeps metadata: loaders stop before it in a file of
version 16 (ModelLoader.cs of 0.2 to 3.0 reads three strings and a list of warnings after the weights, no more).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from converters.barracuda.encode import encode
from converters.barracuda.format import Trailer, parse
from converters.barracuda.lower import policy_model
from converters.format import WriteOptions
from converters.pieces import Pieces
from converters.policy import Policy

CONTRACT_KEY = "export_model_contract"
#: What Barracuda has for a model that no file was imported for.
_NO_SOURCE, _NO_VERSION = "Script", "NA"
PRODUCER = "export-model"


def write(policy: Policy, options: WriteOptions) -> Mapping[str, Pieces]:
    """The ``.nn``. Raises UnsupportedOpError or SignatureError that names what the format cannot hold."""
    trailer = Trailer(_NO_SOURCE, _NO_VERSION, PRODUCER, metadata=((CONTRACT_KEY, options.contract),))
    return {f"{policy.name}.nn": Pieces(encode(replace(policy_model(policy), trailer=trailer)))}


def held(path: Path) -> str:
    """The contract that a ``.nn`` carries, empty where it has none. Raises OSError, DamagedFileError."""
    return parse(path.read_bytes()).metadata(CONTRACT_KEY) or ""
