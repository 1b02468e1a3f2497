"""Networks that paint robot and background: flow matching and super-resolution.

`train` trains them on the image pairs of `pairs`, `painter` applies them; `flow` and `flow_network` are the flow and
its U-Net, `super_resolution` enlarges; `cfg` has the settings.
"""
