"""Calibrations from files: ROS camera_info, Kalibr, EuRoC (ASL) and OpenCV."""
