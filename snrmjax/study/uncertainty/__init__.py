"""How uncertain responses are where the parameters are, and which of them makes them so."""
