"""The numpy reference: the kernels of the op table in a process of their own."""
