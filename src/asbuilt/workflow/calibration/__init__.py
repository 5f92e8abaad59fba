"""Calibration with known or unknown payloads, and of motors against sensors."""
