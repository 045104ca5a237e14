"""One HTML page about a run: map, frames, plots, losses, findings, parameters."""
