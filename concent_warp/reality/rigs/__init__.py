"""Rigs: small experiments in Reality, each with a nominal scene, physics and motions.

`rig` defines and records them, `signals` has command profiles, `registry` all rigs by name; one module for each rig.
"""
