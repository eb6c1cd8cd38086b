"""Episodes of an environment, played by every format in every runtime, and how their returns compare."""
