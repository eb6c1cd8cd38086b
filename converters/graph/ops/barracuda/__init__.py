"""What an op becomes for Barracuda: layers of a ``.nn`` (``OpDef.nn``), or ops that it has (``OpDef.barracuda``)."""
