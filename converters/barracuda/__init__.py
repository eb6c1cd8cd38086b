"""Barracuda ``.nn``: the binary models of Unity's ML-Agents 0.7 to 0.23, read without Unity."""
