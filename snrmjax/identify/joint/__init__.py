"""Both curves, instruments and levels fitted jointly to the force balance of all states."""
