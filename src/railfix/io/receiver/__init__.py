"""Decoders of receiver logs and streams (UBX, RTCM 3, SBF, NMEA): observations, navigation records and positions."""
