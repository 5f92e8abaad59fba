"""Complete runs: the demonstrations and the reproduction of the 2015 paper."""
