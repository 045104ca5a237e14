"""Compiled loops of refinement, one algorithm a file, each beside its plain reference."""
