"""Frozen TensorFlow graphs: ``.bytes`` of Unity ML-Agents 0.1 to 0.6, ``frozen_graph_def.pb`` of 0.7 to 0.23."""
