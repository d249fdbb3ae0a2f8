"""The process: compiled kernels, processors, memory, disk and signals."""
