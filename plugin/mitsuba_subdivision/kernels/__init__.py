"""Dr.Jit kernels; array types follow from the arguments, so that one source serves every backend and precision."""
