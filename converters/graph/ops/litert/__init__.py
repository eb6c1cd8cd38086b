"""How ops are written in LiteRT's operators; entries of the op table name these functions (``OpDef.litert``)."""
