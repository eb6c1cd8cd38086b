"""What the recipes of PyTorch trainers share: weights, layers, activations."""
