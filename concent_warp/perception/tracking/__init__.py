"""Poses of rigid objects from RGB-D video: model-to-frame refinement, first pose, smoothing."""
