"""Results as files for GIS programs, map_server and point cloud viewers, and as pictures."""
