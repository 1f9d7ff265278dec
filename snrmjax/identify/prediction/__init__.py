"""What an identification predicts of a level that was not measured."""
