"""The vectorised environment of a training.

`environment` has rsl-rl's interface and `worlds` makes it; `physics` simulates the worlds; `observation` and `reward`
are computed from their states; `virtual_collision` penalises spheres outside the physics; `randomisation`,
`world_effects` and `command_dynamics` make the worlds differ; `quaternions` rotates.
"""
