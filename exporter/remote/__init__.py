"""Sources and bundles by address, through fsspec (the extra ``remote``)."""
