"""Pipeline files: YAML with line numbers, templates, settings, parameters and units, loaded into a checked graph."""
