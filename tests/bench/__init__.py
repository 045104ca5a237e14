"""Benchmarks, run by `make bench`: they print figures and ratios, side by side, and assert nothing. Their processes
keep memory as a run does."""

from flow.allocator import keep_freed_memory

keep_freed_memory()
