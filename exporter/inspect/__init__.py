"""``inspect``: what is in a source, as text, JSON and pictures."""
