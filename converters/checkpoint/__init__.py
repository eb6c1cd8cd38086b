"""TensorFlow 1.x checkpoints as sources, read without TensorFlow, and the folders that training leaves."""
