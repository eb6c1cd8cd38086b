"""How each op is computed, element by element: what programs without a runtime are printed from."""
