"""Rounds of improvement: failed trials are explained, the cause is mended, the policy is trained on and tried again.

`improve` runs the rounds; `mend` says what follows from an explanation; `steps` are the steps of a round; `rounds` are
what is kept of each; `page` shows them.
"""
