"""Curves of periodic motions: continuation, events and stability along them."""
