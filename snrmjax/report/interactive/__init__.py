"""Figures of a report that answer to the mouse: zoom, hover, levels and states linked."""
