"""Formats: one room for each container of a policy, the list of them, and how files are recognised and read."""
