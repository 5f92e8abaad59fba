"""Logs of ROS: messages that hold joints, topics, the table of both, bags, echoed messages."""
