"""What ROS 1 and ROS 2 messages hold, for bags and for the ROS 2 nodes; nothing in here needs ROS."""
