"""Physical consistency of bodies: bounds, priors, cone programs."""
