"""The command line: one file per group of commands, the demonstration and the 2015 paper."""
