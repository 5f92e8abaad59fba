"""The page in the browser: every step is a command, run as the command line runs it."""
