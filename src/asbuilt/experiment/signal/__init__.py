"""Signal chain from a recording to samples, and the division into training and held-out samples."""
