"""Ensembles of identified robots as sets of files."""
