"""Uncertainty of responses from that of parameters, and its attribution to them."""
