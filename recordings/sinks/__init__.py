"""Outputs of a run: the result log (MCAP) and the rerun recording (blueprint, loggers, colour maps)."""

DESKS = ("overview", "matching", "terrain", "runtime", "tilt")  # of `blueprint`, which is imported only when used

# Entities of a recording beside its streams: losses, captions of the frames, facts of the run, times and queues of the
# stages, the text from which other desks are made, and the names of the curves of a panel, which stand beside the plot.
ENTITIES = ("ledger", "frames", "summary", "seconds", "queues", "layout", "curves")
