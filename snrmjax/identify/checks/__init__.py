"""Whether data determine what a fit was asked for, said in words or refused."""
