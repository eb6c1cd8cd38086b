"""The main job: sources in, verified bundles out."""
