"""Drive terms, one kind per module; the registry finds them all."""
