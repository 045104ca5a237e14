"""Superpixel refinement of disparity (paper sections 3.2 and 3.3): SLIC, planes, filling, WLS, bilateral."""
