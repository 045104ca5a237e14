"""How much two messages differ."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings.comparison.measures import measures
from recordings.ros2.to_msg import disparity_image, grid_map, image, occupancy_grid, odometry, point_cloud
from stages.data import Pose
from tests.recordings.sinks.recorded_scene import scene


def turned(degrees: float) -> Rotation:
    return Rotation.from_rotvec(np.deg2rad([0.0, degrees, 0.0]))


@pytest.mark.parametrize("degrees", [0.0, 0.01, 90.0, 180.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_poses_differ_by_a_distance_and_an_angle(degrees, sign):
    one = Pose(0, np.zeros(3), turned(30.0).as_quat(), "odom", "base_link", None)
    other = replace(one, position=np.array([0.0, 0.02, 0.0]), quaternion=sign * turned(30.0 + degrees).as_quat())
    found = measures("nav_msgs/msg/Odometry", odometry(one), odometry(other))
    assert found["largest position mm"] == pytest.approx(20.0)
    assert found.get("largest angle deg", 0.0) == pytest.approx(degrees, abs=1e-6)


def test_equal_disparities_of_another_camera_differ_by_its_baseline():
    disparity = scene()["disparity"]
    camera = replace(disparity.camera, baseline=1.1 * disparity.camera.baseline)
    pair = disparity_image(disparity), disparity_image(replace(disparity, camera=camera))
    found = measures("stereo_msgs/msg/DisparityImage", *pair)
    assert found == {"largest difference of the baselines mm": pytest.approx(100 * disparity.camera.baseline)}


@pytest.mark.parametrize(
    ("dtype", "channels", "unknown"), [(np.uint8, (), 0), (np.uint8, (3,), 0), (np.float32, (), np.nan)]
)
def test_a_changed_pixel_of_an_image_counts_once(dtype, channels, unknown):
    pixels = np.full((4, 6, *channels), 7, dtype)
    pixels[0, 0] = unknown
    changed = pixels.copy()
    changed[1, 2:4] = 200
    one, other, small = (image(0, "camera", array) for array in (pixels, changed, pixels[:2]))
    assert measures("sensor_msgs/msg/Image", one, other) == {"pixels": 2}
    assert measures("sensor_msgs/msg/Image", one, small) == {"pixels of another size": 24}


def test_maps_far_apart_are_of_another_place():
    near = scene()["elevation_map"]
    cells = near.layers["elevation"].size
    far = replace(near, origin=(near.origin[0] + 2e4, near.origin[1] - 2e4))
    assert measures("grid_map_msgs/msg/GridMap", grid_map(near), grid_map(far)) == {"cells of another place": cells}
    wide = np.zeros((2100, 2100), np.float32)
    changed = wide.copy()
    changed[7, 7] = 1.0
    pair = (grid_map(replace(near, layers={"elevation": layer})) for layer in (wide, changed))
    assert measures("grid_map_msgs/msg/GridMap", *pair)["cells"] == 1
    verdicts = scene()["navigation_map"]
    pair = occupancy_grid(verdicts), occupancy_grid(replace(verdicts, origin=(2e4, 2e4)))
    assert measures("nav_msgs/msg/OccupancyGrid", *pair) == {"cells of another place": verdicts.cells.size}


def test_clouds_differ_by_the_distances_to_the_nearest_points():
    cloud = scene()["points"]
    moved = cloud.points.copy()
    moved[0] += np.float32([0, 0, 50])
    found = measures("sensor_msgs/msg/PointCloud2", *map(point_cloud, (cloud, replace(cloud, points=moved))))
    assert found["largest distance to the nearest point cm"] == pytest.approx(5000, rel=0.2)
    raised = replace(cloud, points=cloud.points + np.float32([0, 0, 0.001]))
    found = measures("sensor_msgs/msg/PointCloud2", *map(point_cloud, (cloud, raised)))
    assert set(found) == {f"{name} distance to the nearest point cm" for name in ("median", "largest")}
    assert found["largest distance to the nearest point cm"] == pytest.approx(0.1, rel=1e-2)
    fewer = cloud.only(np.arange(len(cloud.points)) != 3)
    found = measures("sensor_msgs/msg/PointCloud2", *map(point_cloud, (cloud, fewer)))
    assert found["points more or fewer"] == 1
    nothing = cloud.only(np.zeros(len(cloud.points), bool))
    found = measures("sensor_msgs/msg/PointCloud2", *map(point_cloud, (cloud, nothing)))
    assert found == {"points more or fewer": len(cloud.points)}
