"""Stable-Baselines3's policies, rebuilt from their description and weights."""
