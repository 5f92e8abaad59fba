"""Fleets: many robots over time, kept as information in a ledger."""
