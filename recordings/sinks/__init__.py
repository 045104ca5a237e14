"""Outputs of a run: the result log (MCAP) and the rerun recording (blueprint, loggers, colour maps)."""

DESKS = ("overview", "matching", "terrain", "runtime", "tilt")  # of `blueprint`, which is imported only when used
