"""How to move: motions, their limits and their files."""
