"""Parity: the same inputs through every runtime, and whether the answers agree."""
