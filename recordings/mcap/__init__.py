"""The MCAP container: read whatever its state, and written."""
