"""A payload's pose, from a ground station's Foxglove port to ROS 2."""
