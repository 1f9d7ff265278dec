"""The misfit between a model and measured states, and the fit of effects to it."""
