"""Act with an exported policy: a game or simulator asks, Python decides (ML-Agents called it the External brain)."""
