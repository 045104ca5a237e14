"""Results as files that GIS programs, map_server, point cloud viewers and eyes read."""
