"""Compiled loops of localisation, one algorithm a file, each beside its plain reference."""
