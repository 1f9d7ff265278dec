"""Figures, and reports in HTML that hold them."""
