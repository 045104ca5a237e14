"""What compiled kernels share: jit and its cache, SIMD vectors, two-thread fork/join, workspaces, union-find."""
