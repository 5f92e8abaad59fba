"""Which numbers of a description a recording supports."""
