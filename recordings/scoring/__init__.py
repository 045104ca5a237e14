"""Error metrics of a result log against ground truth."""
