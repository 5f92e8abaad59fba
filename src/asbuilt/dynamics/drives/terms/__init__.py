"""Drive terms, one per file, those of one kind in a folder; the registry finds them all."""
