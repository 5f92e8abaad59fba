from watched_robot import watched  # noqa: F401
