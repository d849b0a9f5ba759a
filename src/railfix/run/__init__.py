"""The batch: logs, navigation and a track map in, tables of positions out."""
