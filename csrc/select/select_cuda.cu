// Filled in by the CUDA half of select.
