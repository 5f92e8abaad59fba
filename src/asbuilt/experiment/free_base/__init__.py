"""Free base: its columns in a log, and what is wrong with them."""
