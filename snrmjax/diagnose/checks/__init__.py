"""Checks of an answer: patterns in the residuals, cross-validation, doubts, the verdict."""
