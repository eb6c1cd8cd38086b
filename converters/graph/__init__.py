"""The compiler's middle: the op table, shapes, and the passes from a source's graph to a policy's."""
