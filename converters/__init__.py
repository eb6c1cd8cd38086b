"""Formats: a room each (frozen_graph, saved_model, tfjs, onnx, barracuda, litert, …), the compiler, the runners.

May import ``signatures``; never ``exporter``.
"""
