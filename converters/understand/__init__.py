"""What a graph means: which brain, which inputs and outputs, which trainer and generation wrote it, what its numbers are for."""
