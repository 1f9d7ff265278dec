"""The laws behind the excess of a test over its model, their fraction, and the remainder."""
