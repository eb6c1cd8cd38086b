"""``compare``: artefacts that any tool made, held against a reference."""
