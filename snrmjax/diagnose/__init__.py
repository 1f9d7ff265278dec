"""What a model lacks: where it disagrees with measured states, what that is, and the proof."""
