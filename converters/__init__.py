"""Formats: a room each (frozen_graph, saved_model, tfjs, onnx), the graph compiler between them, and the runners.

May import ``signatures``; never ``exporter``.
"""
