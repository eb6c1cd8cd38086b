"""Mutants of robots' checkpoints: their settings, their weights, and the pickled policies of SBX."""

from __future__ import annotations

import base64
import io
import json
import tempfile
import zipfile
from pathlib import Path
from random import Random

import yaml

from fixtures.brax import FOLDER as BRAX
from fixtures.robots import FOLDER
from tests.fuzz import changes, mutation
from tests.fuzz.changes import Files
from tests.torch_checkpoint.robots import checkpoint

#: Settings that bytes are put into: anchors, tags, indentation.
_PIECES = (
    b"&a ",
    b"*a",
    b"!!python/tuple ",
    b"- ",
    b"  ",
    b"\n",
    b"{",
    b"]",
    b": ",
    b"1e999",
    b"|\n",
    b"? ",
    b"<<: *a",
)


def runs() -> list[Files]:
    """Return a checkpoint of each kind with its settings beside it."""
    found = []
    for settings in sorted(FOLDER.glob("*.yaml")):
        with tempfile.TemporaryDirectory() as folder:
            path = checkpoint(Path(folder), settings.stem, "policy.pt", "agent.yaml")
            found.append({file.name: file.read_bytes() for file in sorted(path.parent.iterdir())})
    return found


def change_run(files: Files, random: Random) -> Files:
    """Change the settings as a tree or as bytes, or the checkpoint."""
    draw = random.random()
    settings = [n for n in files if n != "policy.pt"]  # FastTD3 has none
    if draw < 0.3 or not settings:
        return {**files, **changes.pickled({"policy.pt": files["policy.pt"]}, random)}
    (name,) = settings
    data = files[name]
    if draw < 0.8:
        tree = mutation.json_tree(yaml.safe_load(data), random)
        changed = json.dumps(tree).encode("utf-8", "surrogatepass")
    elif draw < 0.95:
        at = random.randrange(len(data))
        changed = data[:at] + random.choice(_PIECES) + data[at + random.randrange(3) :]
    else:
        changed = mutation.damaged(data, random)
    return {**files, name: changed}


def modules() -> list[Files]:
    """Return modules that RLlib saved."""
    found = []
    for state in sorted(FOLDER.glob("rllib_*.state.pkl")):
        arguments = state.with_name(state.name.replace(".state.", ".arguments."))
        found.append({"module_state.pkl": state.read_bytes(), "class_and_ctor_args.pkl": arguments.read_bytes()})
    return found


def change_module(files: Files, random: Random) -> Files:
    """Change one of the two pickles by its opcodes, or its bytes."""
    name = random.choice(sorted(files))
    if random.random() < 0.8:
        return {**files, name: mutation.parts(changes.opcodes(files[name]), random, changes.opcode)}
    return {**files, name: mutation.damaged(files[name], random)}


def brax_pickles() -> list[Files]:
    """Return parameters that brax saved, each beside a configuration."""
    config = (BRAX / "ppo_orbax" / "ppo_network_config.json").read_bytes()
    return [{"params.pkl": f.read_bytes(), "ppo_network_config.json": config} for f in sorted(BRAX.glob("*.pkl"))]


def change_brax(files: Files, random: Random) -> Files:
    """Change the pickle by its opcodes or its bytes, or the configuration as a tree."""
    draw = random.random()
    if draw < 0.6:
        return {**files, "params.pkl": mutation.parts(changes.opcodes(files["params.pkl"]), random, changes.opcode)}
    if draw < 0.8:
        return {**files, "params.pkl": mutation.damaged(files["params.pkl"], random)}
    tree = mutation.json_tree(json.loads(files["ppo_network_config.json"]), random)
    return {**files, "ppo_network_config.json": json.dumps(tree).encode("utf-8", "surrogatepass")}


def saved_policies() -> list[Files]:
    """Return models that SBX saved."""
    return [{"policy.zip": f.read_bytes()} for f in sorted(FOLDER.glob("sbx_*.zip"))]


def change_saved_policy(files: Files, random: Random) -> Files:
    """Change the pickled policy by its opcodes, or what stands beside it."""
    with zipfile.ZipFile(io.BytesIO(files["policy.zip"])) as archive:
        entries = {e.filename: archive.read(e) for e in archive.infolist()}
    content = json.loads(entries["data"])
    if random.random() < 0.6:
        code = base64.b64decode(content["policy"][":serialized:"])
        code = mutation.parts(changes.opcodes(code), random, changes.opcode)
        content["policy"][":serialized:"] = base64.b64encode(code).decode()
    else:
        policy = content.pop("policy")
        content = mutation.json_tree(content, random)
        content = {**content, "policy": policy} if isinstance(content, dict) else content
    entries["data"] = json.dumps(content).encode("utf-8", "surrogatepass")
    return {"policy.zip": changes.zipped(entries)}
