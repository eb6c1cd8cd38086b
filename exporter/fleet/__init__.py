"""Many sources at once: found in folders, exported by several processes, and not again while they are unchanged."""
