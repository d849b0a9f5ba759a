"""Readers of RINEX files, and what they are stored in."""
