"""Reduction of logs to the information that a ledger keeps."""
