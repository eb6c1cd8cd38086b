"""Speed, memory and size beside what a user would run instead: ``python -m tests.bench``."""
