"""Estimators for those who compare methods; none is chosen of itself."""
