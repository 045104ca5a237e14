"""A run: graph, alignment into frames, scheduling, ledger of losses, pre-pass over the log, summary."""
