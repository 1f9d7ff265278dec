"""Optimal design of the further test that separates models of equal fit."""
