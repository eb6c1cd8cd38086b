"""LiteRT's operators as nodes: ``importer`` makes the graph, ``table`` names the function of each operator."""
