"""The dataflow runtime: graphs, queues, time and failure. Knows no image, no map, no file format."""
