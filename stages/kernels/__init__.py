"""The compiled inner loops, one algorithm a file, each beside the plain reference that its tests compare with."""

from stages.kernels.cache import install

install()
