"""``export-model serve``: a page on which a bundle's policy acts in the visitor's browser."""
