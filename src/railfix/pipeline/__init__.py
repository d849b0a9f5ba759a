"""Positions of a log or stream, epoch by epoch: settings, processor, results."""
