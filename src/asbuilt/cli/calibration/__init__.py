"""Commands that need a payload or a second channel of torques."""
