"""Drive terms, one per file; `selection` finds them all."""
