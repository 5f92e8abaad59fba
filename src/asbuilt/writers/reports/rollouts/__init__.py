"""Page of rollouts."""
