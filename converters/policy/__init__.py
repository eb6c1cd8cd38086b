"""What a graph means: brains, inputs, outputs, memory, the trainer that wrote it, what its numbers are."""
