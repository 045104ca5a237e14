"""Compiled loops of the matcher, one algorithm a file, each beside its plain reference."""
