"""Formats: a room each (frozen_graph, saved_model, tfjs, onnx, barracuda, litert, …), the compiler, the runners.

May import ``export_model.signatures``; never ``export_model.exporter``.
"""

if __name__ != "export_model.converters":
    raise ImportError("import it as export_model.converters: only what holds export_model belongs on sys.path")
