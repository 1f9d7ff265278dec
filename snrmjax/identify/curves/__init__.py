"""Families of smooth curves of amplitude with a few parameters."""
