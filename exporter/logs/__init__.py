"""Logs from the field: what an agent saw and did, step by step, computed again and explained.

``reading.py`` reads a log (``.npz``, ``.csv``, ``.jsonl``) into a ``Recording``; ``replay.py`` has the policy answer
for its steps; ``judging.py`` says which steps fit; ``causes.py`` is the table of what goes wrong between a policy and
its agent; ``search.py`` looks for the one that explains the steps that do not fit; ``check.py`` does it all.
"""
