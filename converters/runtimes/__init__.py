"""Runtimes as child processes: the frames that cross the pipe, the processes, and the Python children."""
