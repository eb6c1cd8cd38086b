"""What a policy is: its graph, its signature (roles, dtypes, shapes), its contract and its errors.

This package knows numpy and the standard library only. It imports nothing of ``converters`` or ``exporter``.
"""
