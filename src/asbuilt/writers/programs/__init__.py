"""Programs that make controllers run a motion and record it."""
