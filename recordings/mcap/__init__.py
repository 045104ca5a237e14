"""Reads and writes MCAP files; reads damaged ones as far as possible."""
