"""Formats: a room each (frozen_graph, checkpoint, saved_model, tfjs, onnx, barracuda), the compiler, the runners.

May import ``signatures``; never ``exporter``.
"""
