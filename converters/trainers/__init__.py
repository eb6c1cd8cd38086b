"""Trainers' networks rebuilt from a state dictionary, one recipe each."""
