"""Connection to ROS 1 and ROS 2: topics and actions, through rosbridge or ``rospy``."""
