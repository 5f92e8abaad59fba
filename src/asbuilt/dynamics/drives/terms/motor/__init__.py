"""Rotors that several joints turn."""
