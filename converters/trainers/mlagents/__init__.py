"""ML-Agents' PyTorch networks, rebuilt from their weights."""
