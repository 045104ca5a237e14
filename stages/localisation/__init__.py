"""Where the rover is: visual odometry, the pose filter, and checks of logged pose and tilt."""
