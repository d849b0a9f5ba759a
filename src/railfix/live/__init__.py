"""Positions from receiver streams as they arrive: sources, pairing of antennas, one message a period, sinks."""
