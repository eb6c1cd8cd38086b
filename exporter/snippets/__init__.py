"""Code to copy: how a bundle's policy is called in each runtime, made from the bundle's own contract."""
