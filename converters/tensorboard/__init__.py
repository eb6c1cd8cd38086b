"""Graphs for TensorBoard."""
