"""asbuilt."""
