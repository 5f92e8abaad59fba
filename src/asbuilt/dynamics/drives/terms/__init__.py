"""Drive terms, those of one kind in a module; the registry finds them all."""
