"""Whether an answer may be believed: patterns left over, levels left out, doubts."""
