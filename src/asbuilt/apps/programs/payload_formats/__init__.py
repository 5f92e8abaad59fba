"""Payloads in the words of robot makers, one file a maker."""
