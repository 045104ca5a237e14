"""Rectification and the row offset that calibration leaves."""
