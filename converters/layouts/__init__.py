"""Which number is which: known robots, terms of observations and conventions, and how each of them mirrors."""
