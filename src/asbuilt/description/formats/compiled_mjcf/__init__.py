"""What the model that MuJoCo compiles from MJCF says."""
