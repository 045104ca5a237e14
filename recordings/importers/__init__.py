"""Other people's data sets, written as logs."""
