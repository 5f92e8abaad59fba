"""Jaxterity fits robots by simulation without input; a log of torques is none of its."""

PACKAGE = "jaxterity"
REQUIRES = ["jaxterity"]
PYTHON = "3.12"
TITLE = "Jaxterity"
ADDRESS = "https://github.com/machinavitalis/jaxterity"
CANNOT = {
    "*": "fits masses and damping of a robot by simulating it from the first sample, without torque"
    " or command as input (`sysid.inertial`, `full_body` and `contact` of jaxterity 1.2.0,"
    " installed and read on 28 November 2026); its other recipes are for single motors, and its"
    " calibration of servos, by windows, has no adapter here"
}
