"""The compiler: one carrier, a list of passes over it, and what a policy becomes on the way."""
