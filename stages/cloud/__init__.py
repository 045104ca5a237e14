"""From disparity to a levelled point cloud (paper section 4): reproject, clean, level, voxel grid."""
