"""Columns of a log: roles by name, joints, layout, units of single joints, drafts of sheets."""
