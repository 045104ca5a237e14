"""Outputs of a run: the result log (MCAP) and the rerun recording (blueprint, loggers, colour maps)."""
