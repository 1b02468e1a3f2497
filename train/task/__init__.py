"""The task of a training: model, demonstration, contact events, robot.

`task` collects them; `robot` addresses the arm; `slots` selects the contact pairs of the reward; `stages` states when a
stage ends; `movable_fixtures` lets fixed objects stand elsewhere in each world.
"""
