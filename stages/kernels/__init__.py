"""The compiled inner loops, one algorithm a file, each beside the plain reference that its tests compare with."""

import stages.compiled.jit  # noqa: F401  (numba keeps what is compiled after this in the way told there)
