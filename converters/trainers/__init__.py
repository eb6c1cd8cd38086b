"""Trainers' networks rebuilt from a state dictionary: a room each, listed in ``registry.py``."""
