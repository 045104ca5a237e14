"""Public data sets, written as logs."""
