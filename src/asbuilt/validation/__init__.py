"""Does it hold: predictions of other recordings, what their errors look like, CAD against as built."""
