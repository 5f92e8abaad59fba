"""Choice of drive terms and their nonlinear parameters."""
