"""Torque that the drive of one joint adds to the rigid bodies, one term per file.

`selection` finds them all.
"""
