"""ML-Agents' ``configuration.yaml`` of a run: the memory that a behavior was trained with.

Source: mlagents 0.16 to 1.1 (trainers/settings.py; learn.py writes it to the folder of the run). How often an agent
decides is a component's setting in Unity (Decision Requester), and stands in no file of the run.
"""

from __future__ import annotations

from export_model.converters.interfaces.table import Table
from export_model.signatures.interface import Interface, Statement
from export_model.signatures.roles import MEMORY_SIZE


def read_configuration(table: Table, behavior: str) -> Interface:
    """Return what it states of the behavior, or of the only one."""
    behaviors = table.below("behaviors")
    names = [n for n in behaviors if n == behavior or behavior.startswith(f"{n}-")]
    if not names and len([*behaviors]) == 1:
        names = [*behaviors]
    resets = []
    for name in names[:1]:
        memory = behaviors.below(name).below("network_settings").below("memory")
        size, length = memory.count(MEMORY_SIZE), memory.count("sequence_length")
        if size and length:
            text = f"trained with a memory of {size} numbers over sequences of {length} steps"
            resets.append(Statement(text, memory.where()))
    return Interface(resets=tuple(resets), kept=tuple(table.rest()))
