"""Fits of a study: what is held out, the fit that is validated and the final one, what they say."""
