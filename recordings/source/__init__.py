"""From the topics of a log to a pipeline's streams: discovery, calibration, transforms and settings."""
