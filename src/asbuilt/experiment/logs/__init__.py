"""Read logs of any format into recordings."""
