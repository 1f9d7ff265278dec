"""Linear modes from frequency responses, low-level steady states and free decays."""
