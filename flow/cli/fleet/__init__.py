"""Many logs through one pipeline: jobs, their catalogue, and the workers of a Dask cluster."""
