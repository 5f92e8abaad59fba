"""Effects that a description lacks: one object, one pass over the samples, one selection."""
