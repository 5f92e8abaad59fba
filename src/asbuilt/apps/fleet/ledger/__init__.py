"""The ledger: append-only store of the information of logs."""
