"""Bytes from files: fetched, probed, bounded, parsed; this room knows no graph."""
