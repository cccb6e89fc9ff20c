"""A robot with ROS behind a rosbridge server, from the published protocol and the behaviour of ros_controllers."""
