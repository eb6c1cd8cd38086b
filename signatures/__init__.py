"""What a policy is: its graph, its signature (roles, dtypes, shapes), its contract and its errors.

This package knows numpy and the standard library only. It imports nothing of the two others.
"""

if __name__ != "export_model.signatures":
    raise ImportError("import it as export_model.signatures: only what holds export_model belongs on sys.path")
