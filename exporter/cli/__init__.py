"""The command line, and how it speaks."""
