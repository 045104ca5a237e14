"""Compressed video as images."""
