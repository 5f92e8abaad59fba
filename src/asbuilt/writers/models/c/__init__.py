"""C code of a robot's dynamics."""
