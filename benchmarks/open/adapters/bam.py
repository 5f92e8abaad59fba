"""BAM identifies one servo on a pendulum of known inertia; a log of an arm is no input of it."""

PACKAGE = "bam"
REQUIRES = ["bam"]
TITLE = "BAM"
ADDRESS = "https://github.com/Rhoban/bam"
CANNOT = {
    "*": "fits friction models of one actuator on a pendulum bench of known mass and length; it has"
    " no input for a log of an arm (and is not on the package index)"
}
