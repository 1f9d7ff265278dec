"""What a diagnosis knows of every kind of effect: one row of `table.HYPOTHESES` each."""
