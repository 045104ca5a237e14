"""Two rectified images to a picture of the terrain: python two_images_to_dem.py left.png right.png dem.png

The camera, its angle and its height are those of `roverflow simulate --size 640x480` on level ground: set yours.
"""

import sys

import numpy as np
from skimage import io

from recordings.sinks.colormaps import birds_eye, elevation_colors
from stages import Clean, Level, Match, Refine, Reproject, StereoCamera, StereoFrame, Tilt, Voxelise

left, right = map(io.imread, sys.argv[1:3])
camera = StereoCamera(fx=484.5, fy=484.5, cx=317.5, cy=231.7, baseline=0.24, width=left.shape[1], height=left.shape[0])
frame = StereoFrame(0, left, right, camera)
disparity = Refine()(frame, Match(disparities=96)(frame))
cloud = Clean(max_range=6.0)(Reproject()(frame, disparity))
down = np.radians(15)  # how far the camera looks down; up in the camera's frame (x right, y down, z forward)
tilt = Tilt(0, np.array([0, -np.cos(down), -np.sin(down)]), frame_id=camera.frame_id)
terrain = Voxelise(max_range=6.0)(Level(camera_height=0.9)(cloud, tilt))
picture = birds_eye(elevation_colors(terrain))  # x forward is up, one pixel a cell of 5 cm
io.imsave(sys.argv[3], picture)
print(f"{np.isfinite(terrain.layers['elevation']).sum()} cells of {terrain.resolution * 100:.0f} cm are known")
