"""Benchmarks, run by `make bench`: they print figures and ratios, side by side, and assert nothing."""
