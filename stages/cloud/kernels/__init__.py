"""Compiled loops of the point cloud stages, each beside its plain reference."""
