"""How messages are encoded: each encoding gives messages with the fields of ROS 2, so that all checks exist once."""
