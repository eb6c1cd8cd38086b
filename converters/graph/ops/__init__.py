"""The ops by theme (elementwise, linear algebra and reductions, convolution, arrays, chance) and the table of all."""
