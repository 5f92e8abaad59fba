"""Motions as functions of time, and families of motions that a design chooses among."""
