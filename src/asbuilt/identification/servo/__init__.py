"""Gains and delay of position servos from commands and positions."""
