"""The card of a bundle: README.md for a model hub."""
