"""Compiled loops over map grids, each beside its plain reference."""
