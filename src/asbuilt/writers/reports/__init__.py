"""HTML reports and the files that a command leaves."""
