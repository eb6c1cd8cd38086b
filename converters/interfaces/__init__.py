"""What lies beside the weights: what files and metadata state of a policy's inputs, outputs and control loop."""
