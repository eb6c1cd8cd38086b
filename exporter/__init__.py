"""The application: command line, pipeline, bundle, parity, reports, acting, the web page.

``import export_model`` is what users import. Nothing heavy is imported before it is used: a cold start is a feature.
"""

if __name__ != "export_model.exporter":
    raise ImportError("import it as export_model.exporter: only what holds export_model belongs on sys.path")

#: pyproject.toml reads it from here.
__version__ = "0.1.0"
