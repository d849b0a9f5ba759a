"""Receiver logs and streams: UBX, RTCM 3, SBF and NMEA bytes to observations, navigation records and positions."""
