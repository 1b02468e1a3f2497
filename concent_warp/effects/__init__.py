"""Physical effects that a model may lack: one small class each."""
