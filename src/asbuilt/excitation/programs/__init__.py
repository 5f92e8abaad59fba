"""Programs that make real controllers run a motion and record it, one format per file."""
