"""From motion to samples."""
