"""What the robot is: links, joints, mass properties and limits, from every common description."""
