"""ROS bags by topic, without ROS: docs/bags.md."""
