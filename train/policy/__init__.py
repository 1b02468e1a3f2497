"""A trained policy.

`load` reads it with the inputs of its training; `play` steps through a single world; `export` writes ONNX and
TorchScript; `pretrained` names the policies of the package and `write_pretrained` makes one.
"""
