"""Physical consistency of links and drives: bounds, priors, conic and entropic fits."""
