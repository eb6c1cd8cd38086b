"""PyTorch checkpoints (``.pt``) of ML-Agents' trainers: read without PyTorch, and without running what is in them."""
