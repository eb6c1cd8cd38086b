"""Which number is which: a policy's layout, told from its weights as far as a mirror tells it."""
