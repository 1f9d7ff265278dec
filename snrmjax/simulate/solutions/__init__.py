"""What a structure does: forced responses, normal modes, controlled and settled motions."""
