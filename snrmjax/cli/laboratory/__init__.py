"""Commands of a laboratory: files, their check, linear modes, the whole test."""
