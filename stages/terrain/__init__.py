"""From point cloud to DEM and navigation map (paper section 4): voxelise, features, binarise, fuse."""
