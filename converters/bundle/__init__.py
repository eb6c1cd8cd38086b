"""Bundles: the folder that one policy is written to, with its contract; opened, embedded, exchanged."""
