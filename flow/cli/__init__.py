"""The command line: one module a command, and the only place that may import flow, stages and recordings."""
