"""Commands of position servos as torques."""
