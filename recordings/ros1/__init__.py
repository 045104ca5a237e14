"""ROS 1 messages as those of ROS 2."""
